"""How kernels are compiled: one decorator for each part that a function can play.

All keep the compiled code beside the source's cache, and let other Python threads run. Wrappers that nobody
calls cost a good part of the time of compiling a small function, so only a `kernel` has one. Counting
references costs two atomic additions for each array of a named tuple and call, which were the hottest
instructions of the search for tunnels: a `helper` counts none, and in return may neither make arrays nor
return one.
"""

from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

_ALL: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True}
_INNER: dict[str, Any] = _ALL | {"no_cpython_wrapper": True}
_FRUGAL: dict[str, Any] = _INNER | {"_nrt": False}

kernel = njit(**_ALL)
"""Called from Python, or from anywhere."""

maker = njit(**_INNER)
"""Called by kernels alone; may make arrays."""

helper = njit(**_FRUGAL)
"""Called by kernels alone; makes no array."""

inlined = njit(**_FRUGAL, forceinline=True)
"""A helper that is copied to where it is called: for inner loops, as a call passes arrays word by word."""

spliced = njit(inline="always")
"""Called from one place, or tiny: becomes part of its caller before anything is compiled."""


def _fetch(context: Any, array: Any, place: Any) -> Any:
    """Types and code of `fetch`, as Numba asks for them."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        held = context.make_array(signature.args[0])(context, builder, arguments[0])
        line = builder.bitcast(builder.gep(held.data, [arguments[1]]), ir.IntType(8).as_pointer())
        word = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [line.type, word, word, word])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [line.type], kind)
        # To read, kept as near as can be, of data.
        builder.call(prefetch, [line, word(0), word(3), word(1)])
        return context.get_dummy_value()

    return types.void(array, place), generate


fetch: Any = intrinsic(_fetch)
"""`fetch(array, place)` has a number's cache line fetched, without waiting for it.

The array is contiguous; places are counted as if it had one axis.
"""
