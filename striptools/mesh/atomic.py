"""Write a file whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from striptools.errors import WriteError

Content = bytes | Callable[[IO[bytes]], object]
"""What to write: the bytes, or a function that writes them to an open binary file."""


def write_atomically(path: str | Path, content: Content) -> int:
    """Write `content` to a new file beside `path`, then put it in place in one step.

    Until the last step `path` is untouched, and after a failure of any kind (a full disk, an interrupt, an
    exception of the writing function) nothing new is left in the folder. A symbolic link is followed; a
    device or a pipe is written to directly. Safe against the end of the program, not of the machine: nothing
    is synced.

    Args:
        path: The file to create or replace.
        content: Bytes, or a callable that gets the open file.

    Returns:
        How many bytes were written.

    Raises:
        WriteError: Where the file system refuses.
    """
    with refusals_named(path):
        target = Path(os.path.realpath(path))
        if target.exists() and not target.is_file() and not target.is_dir():
            with target.open("wb") as file:
                return write_stream(file, content)
        part = target.with_name(f".{target.name[:80]}.{secrets.token_hex(8)}.part")
        try:
            with part.open("xb") as file:
                _write(file, content)
            size = part.stat().st_size
            part.replace(target)
        except BaseException:
            with suppress(OSError):
                part.unlink()
            raise
        return size


def write_stream(stream: IO[bytes], content: Content) -> int:
    """Write `content` to an open binary stream (standard output, say), flush it, and count the bytes.

    Raises:
        WriteError: Where the stream refuses, as a closed pipe does.
    """
    counter = _Counter(stream)
    with refusals_named(getattr(stream, "name", "the output stream")):
        _write(counter, content)  # pyright: ignore[reportArgumentType]
        stream.flush()
    return counter.size


@contextmanager
def refusals_named(output: object) -> Iterator[None]:
    """Turn an OSError of the block into a WriteError that names `output`."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        raise WriteError(
            f"could not be written: {reason}",
            where=str(output),
            remedy="nothing half-written was left behind",
        ) from error


class _Counter:
    """The writing half of a file, with a count of what went through."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.size = 0

    def write(self, data: bytes) -> int:
        self._stream.write(data)
        self.size += memoryview(data).nbytes
        return memoryview(data).nbytes


def _write(file: IO[bytes], content: Content) -> None:
    if callable(content):
        content(file)
    else:
        file.write(content)
