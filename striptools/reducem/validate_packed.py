"""The validator's way into packed sections: one Zstandard frame, within the bounds of the specification."""

import struct
from collections.abc import Callable
from importlib import import_module

__all__ = ["unpack"]

_MAGIC = 0xFD2FB528
_LARGEST_WINDOW = 2**27


def unpack(stored: bytes, least: int, most: int) -> tuple[str, bytes]:
    """Decode one Zstandard frame.

    Args:
        stored: The stored bytes of the section.
        least: The least bytes that must come out.
        most: The most; no more are allocated.

    Returns:
        The code of an issue, or an empty one, and the decoded bytes.
    """
    if not _frame_is_allowed(stored, least, most) or not _frame_is_whole(stored):
        return "RDM121", b""
    decode = _decoder()
    if decode is None:
        return "RDM123", b""
    try:
        payload = decode(stored, most)
    except Exception:
        # Each library has errors of its own; whatever it says, these bytes do not decode.
        return "RDM121", b""
    return ("", payload) if least <= len(payload) <= most else ("RDM121", b"")


def _frame_is_allowed(stored: bytes, least: int, most: int) -> bool:
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
    return len(field) == size and least <= length <= most and not (single and length > _LARGEST_WINDOW)


def _frame_is_whole(stored: bytes) -> bool:
    """Whether the blocks of the frame, and its checksum where it has one, end where the stored bytes do."""
    descriptor = stored[4]
    single = descriptor >> 5 & 1
    at = 6 - single + (single, 2, 4, 8)[descriptor >> 6]
    last = False
    while not last and at + 3 <= len(stored):
        header = int.from_bytes(stored[at : at + 3], "little")
        last, kind, size = bool(header & 1), header >> 1 & 3, header >> 3
        at += 3 + (1 if kind == 1 else size)
    return last and at + 4 * (descriptor >> 2 & 1) == len(stored)


def _decoder() -> Callable[[bytes, int], bytes] | None:
    """A function from stored bytes and a length to decoded bytes, where the package for it is here."""
    try:
        library = import_module("zstandard")
    except ImportError:
        return None
    # In one go, because a stream would get a window of up to 2^27 bytes whatever the length.
    decoder = library.ZstdDecompressor(max_window_size=_LARGEST_WINDOW)
    return lambda stored, length: decoder.decompress(stored, max_output_size=length)
