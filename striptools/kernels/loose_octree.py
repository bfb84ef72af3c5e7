"""Kernels of the loose octree: where an object belongs, the keys that sort objects, and the sweep over them.

Where an object belongs is one word of 64 bits: the Morton code of its cell, then a 1, then zeros. So the
lowest bit that is set tells the level, and what is above it is twice the adjusted Morton code m'.
"""

import numpy as np

from striptools.kernels.binary_nodes import STACK, join_two, new_forest, put_leaf
from striptools.kernels.compiled import inlined, kernel
from striptools.kernels.morton import MOST_BITS, spread_bits

LEVELS = 3 * MOST_BITS
"""Binary levels below the root: three to a level of the octree."""

ONE = np.uint64(1)


@kernel
def bounds_of_boxes(boxes, begin, end, bounds):
    """Fill bounds (6,) with those of the boxes `begin:end`; False where a box is not finite, or inverted."""
    low_x = low_y = low_z = np.float32(np.inf)
    high_x = high_y = high_z = np.float32(-np.inf)
    sound = True
    for item in range(begin, end):
        low_x, low_y, low_z = (
            min(low_x, boxes[item, 0]),
            min(low_y, boxes[item, 1]),
            min(low_z, boxes[item, 2]),
        )
        high_x, high_y, high_z = (
            max(high_x, boxes[item, 3]),
            max(high_y, boxes[item, 4]),
            max(high_z, boxes[item, 5]),
        )
        for axis in range(3):
            low, high = boxes[item, axis], boxes[item, axis + 3]
            sound &= low <= high and high - high == 0 and low - low == 0
    bounds[0], bounds[1], bounds[2] = low_x, low_y, low_z
    bounds[3], bounds[4], bounds[5] = high_x, high_y, high_z
    return sound


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
def cell_at(place, low, scale):
    """Which of 2**21 cells a place is in; places outside are in the nearest."""
    cell = (place - low) * scale
    last = np.float64((1 << MOST_BITS) - 1)
    return np.int64(min(max(cell, 0.0), last))


@inlined
def fits(box_low, box_high, low, cell, size):
    """Whether a loose cell holds an object on an axis: half a cell more on either side."""
    return box_low >= low + (cell - 0.5) * size and box_high <= low + (cell + 1.5) * size


@kernel
def place_words(boxes, begin, end, low, size, by_extent, words):
    """Say where the objects `begin:end` belong, and give the bits in which their words differ from none.

    Args:
        boxes: (p, 6) float32, finite.
        begin: The first object.
        end: The one behind the last.
        low: (3,) float64, the low corner of the root's cell.
        size: Its side, > 0.
        by_extent: Whether an object goes to the finest cell that holds it when loose; else to the finest.
        words: (p,) uint64 to fill.

    Returns:
        All words joined by or.
    """
    scale = (1 << MOST_BITS) / size
    seen = np.uint64(0)
    for item in range(begin, end):
        low_x, low_y, low_z = (
            np.float64(boxes[item, 0]),
            np.float64(boxes[item, 1]),
            np.float64(boxes[item, 2]),
        )
        high_x, high_y, high_z = (
            np.float64(boxes[item, 3]),
            np.float64(boxes[item, 4]),
            np.float64(boxes[item, 5]),
        )
        x = cell_at((low_x + high_x) * 0.5, low[0], scale)
        y = cell_at((low_y + high_y) * 0.5, low[1], scale)
        z = cell_at((low_z + high_z) * 0.5, low[2], scale)
        level = np.int64(MOST_BITS)
        if by_extent:
            # A cell as large as the object holds it, wherever in the cell its centre is.
            extent = max(max(high_x - low_x, high_y - low_y), high_z - low_z)
            cell = size * 2.0**-MOST_BITS
            while cell < extent and level > 0:
                level -= 1
                cell *= 2.0

            # One of half that side may, and none of a quarter does.
            if level < MOST_BITS:
                finer = np.int64(MOST_BITS - 1) - level
                cell *= 0.5
                if (
                    fits(low_x, high_x, low[0], x >> finer, cell)
                    and fits(low_y, high_y, low[1], y >> finer, cell)
                    and fits(low_z, high_z, low[2], z >> finer, cell)
                ):
                    level += 1
        code = (
            (spread_bits(np.uint64(x)) << np.uint64(2))
            | (spread_bits(np.uint64(y)) << ONE)
            | spread_bits(np.uint64(z))
        )
        mark = ONE << np.uint64(LEVELS - 3 * level)
        word = ((code << ONE) & ~((mark << ONE) - ONE)) | mark
        words[item] = word
        seen |= word
    return seen


@kernel
def depth_first_keys(words, begin, end, spare, deepest, keys):
    """Give the words `begin:end` the levels that are in use, and the keys of the depth-first order.

    Args:
        words: (p,) uint64, shifted down by `spare`.
        begin: The first object.
        end: The one behind the last.
        spare: Levels that no object is at, below the deepest one in use.
        deepest: That level, L'.
        keys: (p,) uint64 to fill: l - popc(m') + 2 m'.
    """
    for item in range(begin, end):
        word = words[item] >> np.uint64(spare)
        words[item] = word
        twice = word & (word - ONE)
        level = np.uint64(deepest) - ones_in(~word & (word - ONE))
        keys[item] = level - ones_in(twice) + twice


@inlined
def apart(one, one_place, other, other_place):
    """How far two objects are from a common cell: smaller where theta(one, other) is larger.

    The bits from the highest one down that m' of both differ in or, where that is more, those below the
    other's level. Of objects in the same cell those are the closer ones whose places share more high bits,
    and all are closer than any two in different cells.
    """
    if one == other:
        return np.int64(below_highest(np.uint64(one_place ^ other_place))) - (np.int64(1) << 32)
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
