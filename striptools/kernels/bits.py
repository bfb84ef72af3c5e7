"""Bits of whole numbers, for kernels."""

import numpy as np

from striptools.kernels.compiled import inlined


@inlined
def bits_set(number):
    """How many bits of a number are set: written as LLVM knows it, which makes it one instruction."""
    n = np.uint64(number)
    n -= n >> np.uint64(1) & np.uint64(0x5555555555555555)
    n = (n & np.uint64(0x3333333333333333)) + (n >> np.uint64(2) & np.uint64(0x3333333333333333))
    n = n + (n >> np.uint64(4)) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64(n * np.uint64(0x0101010101010101) >> np.uint64(56))


@inlined
def highest_bit(number):
    """The place of the highest bit that is set of a number below 2**32, not zero: a float's exponent."""
    return (np.float64(number).view(np.int64) >> 52) - 1023
