"""Loops over the arrays of a scene: gathering, and the rules that a scene file keeps."""

import numpy as np

from striptools.kernels.compiled import kernel


@kernel
def gather_items(items, chosen, begin, end, out):
    """Copy the items `chosen[begin:end]` to their places in out."""
    for k in range(begin, end):
        out[k] = items[chosen[k]]


@kernel
def first_row_off_grid(rows, per_unit):
    """The first of the rows of (q, 3) float32 with an entry that is no multiple of 1 / per_unit, or -1."""
    for k in range(rows.shape[0]):
        for axis in range(3):
            # A float32 times a power of two is exact in float64.
            cells = rows[k, axis] * per_unit
            if np.floor(cells) != cells:
                return k
    return -1


@kernel
def has_repeat(items, seen):
    """Whether an item stands twice; every item is a place in seen, all False."""
    for k in range(items.shape[0]):
        if seen[items[k]]:
            return True
        seen[items[k]] = True
    return False
