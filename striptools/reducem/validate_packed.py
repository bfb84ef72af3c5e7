"""The validator's way into packed sections: one Zstandard frame, within the bounds of the specification."""

import struct
from collections.abc import Callable
from importlib import import_module

__all__ = ["unpack"]

_MAGIC = 0xFD2FB528
_LARGEST_WINDOW = 2**27


def unpack(stored: bytes, raw_length: int) -> tuple[str, bytes]:
    """Decode one Zstandard frame.

    Args:
        stored: The stored bytes of the section.
        raw_length: The bytes that must come out; no more are allocated.

    Returns:
        The code of an issue, or an empty one, and the decoded bytes.
    """
    if not _frame_is_allowed(stored, raw_length):
        return "RDM121", b""
    decode = _decoder()
    if decode is None:
        return "RDM123", b""
    try:
        payload = decode(stored, raw_length)
    except Exception:
        # Each library has errors of its own; whatever it says, these bytes do not decode.
        return "RDM121", b""
    return ("", payload) if len(payload) == raw_length else ("RDM121", b"")


def _frame_is_allowed(stored: bytes, raw_length: int) -> bool:
    """Whether the frame's header (RFC 8878, 3.1.1) has no dictionary, and window and length within bounds."""
    if len(stored) < 6 or struct.unpack_from("<I", stored)[0] != _MAGIC:
        return False
    descriptor = stored[4]
    single, dictionary = descriptor >> 5 & 1, descriptor & 3
    if dictionary or descriptor & 8:
        return False
    at = 5
    if not single:
        base = 1 << (10 + (stored[5] >> 3))
        if base + (base >> 3) * (stored[5] & 7) > _LARGEST_WINDOW:
            return False
        at = 6
    size = (single, 2, 4, 8)[descriptor >> 6]
    if size == 0:
        return True
    field = stored[at : at + size]
    length = int.from_bytes(field, "little") + (256 if size == 2 else 0)
    return len(field) == size and length == raw_length and not (single and length > _LARGEST_WINDOW)


def _decoder() -> Callable[[bytes, int], bytes] | None:
    """A function from stored bytes and a length to decoded bytes, of whichever library is here."""
    for name in ("compression.zstd", "backports.zstd"):
        try:
            library = import_module(name)
        except ImportError:
            continue
        return lambda stored, length: _decode_whole(library.ZstdDecompressor(), stored, length)
    try:
        library = import_module("zstandard")
    except ImportError:
        return None
    return lambda stored, length: _decode_object(library, stored, length)


def _decode_whole(decompressor, stored: bytes, length: int) -> bytes:
    # One byte more than there may be, so that a longer frame shows.
    payload = decompressor.decompress(stored, max_length=length + 1)
    return payload if decompressor.eof and not decompressor.unused_data else b""


def _decode_object(library, stored: bytes, length: int) -> bytes:
    reader = library.ZstdDecompressor(max_window_size=_LARGEST_WINDOW).decompressobj()
    payload = reader.decompress(stored)
    return payload if reader.eof and not reader.unused_data and len(payload) == length else b""
