"""Files, standard input and standard output under one roof: formats, refusals, clean failures."""

import io
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from striptools.errors import UnreadableMeshError, UsageError, WriteError
from striptools.reducem.layout import MAGIC

STANDARD = "-"
"""The name that stands for standard input or standard output."""

SCENE_FORMAT = "rdm"

_PIECE = 1 << 20


@dataclass(frozen=True)
class Source:
    """A file to read, or standard input.

    Attributes:
        name: The path, or `-`.
        file: What a loader takes: the path, or the bytes of standard input.
        size: Bytes; 0 for a file that cannot be asked.
    """

    name: str
    file: Path | IO[bytes]
    size: int

    @classmethod
    def open(cls, name: str) -> "Source":
        """Take a path, or read standard input to its end.

        Raises:
            UnreadableMeshError: There is no such file.
        """
        if name == STANDARD:
            # Piece by piece, so that a signal between two pieces is not held up by the next.
            data = b"".join(iter(lambda: os.read(sys.stdin.fileno(), _PIECE), b""))
            return cls("standard input", io.BytesIO(data), len(data))
        path = Path(name)
        try:
            return cls(name, path, path.stat().st_size)
        except OSError as error:
            raise UnreadableMeshError(error.strerror or "cannot be read", where=name) from error

    @property
    def title(self) -> str:
        """The last part of the name."""
        return self.file.name if isinstance(self.file, Path) else self.name


@dataclass
class Target:
    """A file to write, or standard output.

    Attributes:
        name: The path, or `-`.
        size: Bytes written so far.
    """

    name: str
    size: int = field(default=0, init=False)

    @classmethod
    def open(cls, name: str, *, force: bool) -> "Target":
        """Take a path that may be written.

        Raises:
            UsageError: The file exists and `force` is not given, it is a folder, or it is a terminal.
        """
        if name == STANDARD:
            if sys.stdout.isatty():
                raise UsageError("standard output is a terminal", remedy="redirect it, or name a file")
            return cls(name)
        path = Path(name)
        if path.is_dir():
            raise UsageError("is a folder", where=name, remedy="name a file")
        if path.is_file() and not force:
            raise UsageError("exists already", where=name, remedy="--force replaces it")
        return cls(name)

    @property
    def is_standard(self) -> bool:
        """Whether the bytes go to standard output, so that reports must not."""
        return self.name == STANDARD

    @property
    def title(self) -> str:
        """The last part of the name."""
        return "standard output" if self.is_standard else Path(self.name).name

    def write(self, save: Callable[[Path | IO[bytes]], object]) -> None:
        """Have `save` write the file; standard output gets its bytes afterwards, whole.

        Raises:
            WriteError: The bytes could not be written.
        """
        if not self.is_standard:
            path = Path(self.name)
            save(path)
            self.size = path.stat().st_size
            return
        buffer = io.BytesIO()
        save(buffer)
        data = buffer.getvalue()
        _write_standard(lambda: sys.stdout.buffer.write(data))
        self.size = len(data)


def say(text: str, *, error: bool = False) -> None:
    """Write lines to standard output, or to standard error.

    Raises:
        WriteError: Standard output is closed or full.
    """
    if error:
        sys.stderr.write(text)
        sys.stderr.flush()
    else:
        _write_standard(lambda: sys.stdout.write(text))


def input_format(source: Source, given: str | None) -> str:
    """The format of an input: by `--from`, or the first bytes of a scene file, or the extension.

    An empty answer leaves it to the loader, which knows more first bytes.
    """
    if given:
        return given.lower().removeprefix(".")
    if _is_scene(source):
        return SCENE_FORMAT
    return source.file.suffix.lower().removeprefix(".") if isinstance(source.file, Path) else ""


def output_format(name: str, given: str | None, known: tuple[str, ...]) -> str:
    """The format of an output: by `--to`, or the extension.

    Raises:
        UsageError: Neither tells, or it is not one of `known`.
    """
    found = (given or ("" if name == STANDARD else Path(name).suffix)).lower().removeprefix(".")
    if found in known:
        return found
    what = f"unknown format {found!r}" if found else "no name tells its format"
    where = "standard output" if name == STANDARD else name
    raise UsageError(what, where=where, remedy=f"name one by --to or by the extension: {', '.join(known)}")


def refuse_same(first: str, second: str) -> None:
    """Refuse two names of one file.

    Raises:
        UsageError: Both names lead to the same file.
    """
    if STANDARD in (first, second):
        return
    if os.path.realpath(first) == os.path.realpath(second):
        raise UsageError("would be read and written at once", where=first, remedy="name another file")


def folder_for(name: str) -> Path:
    """The folder to write to, made where it is missing; before any work, so that none is lost.

    Raises:
        UsageError: It is a file.
        WriteError: It cannot be made.
    """
    path = Path(name)
    if path.exists() and not path.is_dir():
        raise UsageError("is no folder", where=name, remedy="name a folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WriteError(error.strerror or "cannot be made", where=name) from error
    return path


def _is_scene(source: Source) -> bool:
    if not isinstance(source.file, Path):
        start = source.file.read(len(MAGIC))
        source.file.seek(0)
        return start == MAGIC
    try:
        with source.file.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def _write_standard(write: Callable[[], object]) -> None:
    try:
        write()
        sys.stdout.flush()
    except OSError as error:
        _abandon_standard_output()
        what = "closed by its reader" if isinstance(error, BrokenPipeError) else error.strerror
        raise WriteError(what or "cannot be written", where="standard output") from error


def _abandon_standard_output() -> None:
    # The interpreter flushes standard output once more at its end, and would fail again.
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        sys.stdout = io.StringIO()
