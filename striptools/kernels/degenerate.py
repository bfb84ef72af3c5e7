"""Sort faces into usable, broken and doubtful ones with one pass of float64 arithmetic."""

import numpy as np

from striptools.kernels.compiled import kernel

USABLE = 0
NON_FINITE = 1
REPEATED_VERTEX = 2
DOUBTFUL = 3
"""The face may have zero area: float64 cannot tell."""

CROSS_ERROR = 8.0 * 2.0**-53
"""Each component of the cross product below is computed within this times the sum of its two products' sizes.

Two rounded differences, two rounded products and one rounded subtraction make (1 + u)^4 - 1 < 4.01 u of that
sum, u = 2^-53; the rest is reserve. Nothing under- or overflows: the products of float32 differences lie
between 2^-298 and 2^258.
"""


@kernel
def classify_faces(positions, faces, begin, end, verdict):
    """Write one of the constants above to `verdict`, `(n,)` uint8, for the faces `begin:end`.

    `positions` are float32.
    """
    for face in range(begin, end):
        a = faces[face, 0]
        b = faces[face, 1]
        c = faces[face, 2]

        # Reject corners that are not finite, then corners that are one vertex.
        finite = True
        for axis in range(3):
            finite = finite and np.isfinite(positions[a, axis])
            finite = finite and np.isfinite(positions[b, axis])
            finite = finite and np.isfinite(positions[c, axis])
        if not finite:
            verdict[face] = NON_FINITE
            continue
        if a == b or b == c or c == a:
            verdict[face] = REPEATED_VERTEX
            continue

        # Accept a face with a component of its normal that is larger than its own rounding error.
        verdict[face] = DOUBTFUL
        for axis in range(3):
            i = (axis + 1) % 3
            j = (axis + 2) % 3
            left = (np.float64(positions[b, i]) - np.float64(positions[a, i])) * (
                np.float64(positions[c, j]) - np.float64(positions[a, j])
            )
            right = (np.float64(positions[b, j]) - np.float64(positions[a, j])) * (
                np.float64(positions[c, i]) - np.float64(positions[a, i])
            )
            if abs(left - right) > CROSS_ERROR * (abs(left) + abs(right)):
                verdict[face] = USABLE
                break
