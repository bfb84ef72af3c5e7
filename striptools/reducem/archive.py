"""The codec of archives: one Zstandard frame a section, within the bounds of SPEC.md, section 6."""

from types import ModuleType

import numpy as np

from striptools.errors import MissingExtraError
from striptools.reducem import layout
from striptools.reducem.issues import unreadable

__all__ = ["compressed", "expanded"]

LEVEL = 12
"""Of Zstandard: packed bits hardly shrink at any level, and the rest gains little from a higher one."""


def compressed(payload: bytes | memoryview) -> bytes:
    """The payload as one frame that says how long it is.

    Raises:
        MissingExtraError: The package `zstandard` is not installed.
    """
    return _library("scene").ZstdCompressor(level=LEVEL, write_checksum=False).compress(payload)


def expanded(stored: memoryview, raw_length: int, where: str) -> np.ndarray:
    """The bytes in a frame, (raw_length,) uint8 and writable; no more than that are allocated.

    Args:
        stored: The frame, and nothing behind it.
        raw_length: How many bytes there have to be.
        where: What an error names as its place.

    Raises:
        UnreadableSceneError: It is no such frame.
        MissingExtraError: The package `zstandard` is not installed.
    """
    library = _library(where)
    try:
        frame = library.get_frame_parameters(stored)
        known = frame.content_size != library.CONTENTSIZE_UNKNOWN
        # A frame of a single segment has no window of its own: its content is the window.
        largest = 1 << layout.LARGEST_WINDOW
        if frame.dict_id or frame.window_size > largest or (known and frame.content_size != raw_length):
            raise unreadable("RDM121", where)
        decoder = library.ZstdDecompressor(max_window_size=largest)
        raw = decoder.decompress(stored, max_output_size=raw_length, allow_extra_data=False)
    except library.ZstdError as error:
        raise unreadable("RDM121", where) from error
    if len(raw) != raw_length:
        raise unreadable("RDM121", where)
    return np.frombuffer(bytearray(raw), np.uint8)


def _library(where: str) -> ModuleType:
    try:
        import zstandard
    except ImportError as error:
        raise MissingExtraError(
            "an archive needs the package zstandard", where=where, remedy="pip install 'striptools[archive]'"
        ) from error
    return zstandard
