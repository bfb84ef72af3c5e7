"""How kernels are compiled: one decorator for each part that a function can play.

All keep the compiled code beside the source's cache, and let other Python threads run. Wrappers that nobody
calls cost half of the time of compiling a small function, so only a `kernel` has one. Counting references
costs two atomic additions for each array of a named tuple and call, which made up three quarters of the time
of the search for tunnels: a `helper` has none, and in return may not make arrays.
"""

from numba import njit

kernel = njit(cache=True, nogil=True, no_cfunc_wrapper=True)
"""Called from Python, or from anywhere."""

maker = njit(cache=True, nogil=True, no_cfunc_wrapper=True, no_cpython_wrapper=True)
"""Called by kernels alone, and may make arrays."""

helper = njit(cache=True, nogil=True, no_cfunc_wrapper=True, no_cpython_wrapper=True, _nrt=False)
"""Called by kernels alone, and makes no array."""

inlined = njit(
    cache=True, nogil=True, no_cfunc_wrapper=True, no_cpython_wrapper=True, _nrt=False, forceinline=True
)
"""A helper that is copied to where it is called: for inner loops, as a call passes arrays word by word."""

spliced = njit(inline="always")
"""Called from one place or tiny: becomes part of its caller before anything is compiled."""
