"""Kernels of the loose octree: where an object belongs, the keys that sort objects, and the sweep over them.

Where an object belongs is one word of 64 bits. The high 49 say the cell: its Morton code, then a 1, then
zeros; so the lowest bit that is set tells the level l, and what is above it is twice the adjusted code m'.
The low 15 are the next bits of the Morton code of the object's centre, finer than the cell.
"""

import numpy as np

from striptools.kernels.binary_nodes import STACK, join_two, new_forest, put_leaf
from striptools.kernels.compiled import inlined, kernel
from striptools.kernels.morton import MOST_BITS, spread_bits

MOST_HALVINGS = 16
LEVELS = 3 * MOST_HALVINGS
"""Binary levels below the root, three to a level of the octree."""

FINER_BITS = 3 * MOST_BITS - LEVELS
FINER = np.uint64((1 << FINER_BITS) - 1)
"""At the deepest level the finer bits complete the Morton code of 63 bits."""

SAME_CELL = np.int64(1) << 62
ONE = np.uint64(1)


@kernel
def bounds_of_boxes(boxes, begin, end):
    """The bounds of the boxes `begin:end`, (6,) float32, or NaN where a box is not finite or inverted."""
    bounds = np.full(6, -np.inf, np.float32)
    sound = True
    for item in range(begin, end):
        for axis in range(3):
            low, high = boxes[item, axis], boxes[item, axis + 3]
            sound &= -np.inf < low <= high < np.inf
            bounds[axis] = max(bounds[axis], -low)
            bounds[axis + 3] = max(bounds[axis + 3], high)
    for axis in range(3):
        bounds[axis] = -bounds[axis]
    if not sound:
        bounds[:] = np.nan
    return bounds


@inlined
def ones_in(x):
    """How many bits of a uint64 are set."""
    x = x - ((x >> ONE) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


@inlined
def below_highest(x):
    """All bits from the highest one set down."""
    x |= x >> ONE
    x |= x >> np.uint64(2)
    x |= x >> np.uint64(4)
    x |= x >> np.uint64(8)
    x |= x >> np.uint64(16)
    return x | (x >> np.uint64(32))


@inlined
def finest_cell(begin, end):
    """Which of 2**21 cells the middle is in; one outside is in the nearest."""
    last = np.float64((1 << MOST_BITS) - 1)
    return np.int64(min(max((begin + end) * (1 << (MOST_BITS - 1)), 0.0), last))


@inlined
def halvings(begin, end, place):
    """How often the root's cell may be halved on an axis so that, made loose, it holds an object.

    A loose cell is half a cell larger on either side. `begin` and `end` are the object's sides in units of
    the root's cell, `place` is the finest cell of its centre.
    """
    # A cell as large as the object holds it, wherever in the cell its centre is: read off the exponent.
    count = np.int64(1022) - ((np.float64(end - begin).view(np.int64) - 1) >> 52)
    count = min(count, MOST_HALVINGS - 1)

    # One of half that side may, and none of a quarter does.
    scale = np.int64((count + 1024) << 52).view(np.float64)
    cell = np.float64(place >> (MOST_BITS - 1 - count))
    return count + np.int64(begin * scale >= cell - 0.5 and end * scale <= cell + 1.5)


@kernel
def place_words(boxes, begin, end, low, size, by_extent, words):
    """Say where the objects `begin:end` belong.

    Args:
        boxes: (p, 6) float32, finite.
        begin: The first object.
        end: The one behind the last.
        low: (3,) float64, the low corner of the root's cell.
        size: Its side, > 0.
        by_extent: Whether an object goes to the finest cell that holds it when loose; else all go to the
            finest there are.
        words: (p,) uint64 to fill.

    Returns:
        The cells of all words, joined by or.
    """
    unit = 1.0 / size
    seen = np.uint64(0)
    for item in range(begin, end):
        low_x, high_x = (boxes[item, 0] - low[0]) * unit, (boxes[item, 3] - low[0]) * unit
        low_y, high_y = (boxes[item, 1] - low[1]) * unit, (boxes[item, 4] - low[1]) * unit
        low_z, high_z = (boxes[item, 2] - low[2]) * unit, (boxes[item, 5] - low[2]) * unit
        x, y, z = finest_cell(low_x, high_x), finest_cell(low_y, high_y), finest_cell(low_z, high_z)
        level = np.int64(LEVELS)
        if by_extent:
            # Binary levels halve x, then y, then z.
            on_x, on_y, on_z = (
                halvings(low_x, high_x, x),
                halvings(low_y, high_y, y),
                halvings(low_z, high_z, z),
            )
            level = min(min(min(3 * on_x, 3 * on_y + 1), 3 * on_z + 2), level)
        code = spread_bits(np.uint64(x)) << np.uint64(2)
        code |= spread_bits(np.uint64(y)) << ONE
        code |= spread_bits(np.uint64(z))

        # Put together the cell's code, a 1, zeros, and the next bits of the centre's code.
        finer_bits = (code >> np.uint64(LEVELS - level)) & FINER
        mark = ONE << np.uint64(LEVELS - level)
        cell = (code >> np.uint64(FINER_BITS - 1)) & ~((mark << ONE) - ONE)
        words[item] = ((cell | mark) << np.uint64(FINER_BITS)) | finer_bits
        seen |= cell | mark
    return seen


@kernel
def depth_first_keys(words, begin, end, spare, deepest, keys):
    """Leave out of the words `begin:end` the levels that no object is at, and give their keys.

    Args:
        words: (p,) uint64, of which the cells are shifted down by `spare`.
        begin: The first object.
        end: The one behind the last.
        spare: Levels below the deepest one in use.
        deepest: That level, L'.
        keys: (p,) uint64 to fill: k = l - popc(m') + 2 m', then the finer bits of the centre.
    """
    for item in range(begin, end):
        finer = words[item] & FINER
        cell = words[item] >> np.uint64(FINER_BITS + spare)
        twice = cell & (cell - ONE)
        level = np.uint64(deepest) - ones_in(~cell & (cell - ONE))
        words[item] = (cell << np.uint64(FINER_BITS)) | finer
        keys[item] = ((level - ones_in(twice) + twice) << np.uint64(FINER_BITS)) | finer


@inlined
def apart(one, one_place, other, other_place):
    """How far two objects are from a common cell: smaller where theta(one, other) is larger.

    The bits from the highest one down that m' of both differ in or, where that is more, those below the
    other's level. Objects in the same cell are closer than any two that are not: by the finer bits of their
    centres, then by their places.
    """
    differ = one ^ other
    if differ == 0:
        return np.int64(below_highest(np.uint64(one_place ^ other_place))) - SAME_CELL
    if differ <= FINER:
        return (np.int64(below_highest(differ)) << 32) - SAME_CELL
    one >>= np.uint64(FINER_BITS)
    other >>= np.uint64(FINER_BITS)
    differ = (one & (one - ONE)) ^ (other & (other - ONE))
    return np.int64((below_highest(differ) >> ONE) | (~other & (other - ONE)))


@kernel
def join_by_keys(order, words, boxes, most, node_cost, leaf_cost):
    """Build the hierarchy from below, over objects in the order of their keys.

    A finished range i .. j-1 goes together with what is behind it where theta(i, j) >= theta(i, i-1), else
    with what is before it. Going through the objects from the last to the first, what is behind is finished.

    Args:
        order: (p,) int32, objects by key, those of equal key one after another.
        words: (p,) uint64 of the objects.
        boxes: (p, 6) float32 of the objects.
        most: The most objects that a leaf may be made of.
        node_cost: Cost of visiting an inner node.
        leaf_cost: Cost of visiting a leaf.

    Returns:
        (2p-1, 8) uint32 nodes, and the first of them that is one.
    """
    count = order.shape[0]
    forest = new_forest(2 * count - 1)
    stack_words = np.empty(STACK, np.uint64)
    last = 2 * count - 1
    height = 0
    word = words[order[count - 1]]
    for i in range(count - 1, -1, -1):
        # Put the object on the stack, where what is behind it waits.
        last = put_leaf(forest, height, last, i, boxes, order[i], leaf_cost)
        stack_words[height] = word
        height += 1
        here = word
        to_left = np.int64(0x7FFFFFFFFFFFFFFF)
        if i > 0:
            word = words[order[i - 1]]
            to_left = apart(here, i, word, i - 1)

        # Join with what is behind for as long as that is no farther than what is before.
        while height > 1 and apart(here, i, stack_words[height - 2], forest.items[height - 2, 0]) <= to_left:
            height -= 1
            last = join_two(forest, height, last, most, node_cost, leaf_cost)
            stack_words[height - 1] = here
    return forest.nodes, last
