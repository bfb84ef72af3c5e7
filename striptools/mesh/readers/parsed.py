"""What every reader returns, and what several need: fans, notes, parts put together, trimesh kept quiet."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO

import numpy as np

from striptools.errors import LimitError, UnreadableMeshError
from striptools.mesh.attributes import Attribute, Material, join_attributes, tidy_name
from striptools.mesh.instances import Geometries, Instances
from striptools.mesh.mesh import MOST_FACES

EXPORT_AGAIN = "export the model again"


@dataclass(frozen=True, eq=False)
class Parsed:
    """A mesh as a reader found it, indices not yet checked.

    Args:
        positions: `(v, 3)` floating point.
        faces: `(f, 3)` of any integer type, in file order.
        notes: What the reader had to do.
        attributes: What else it found, of right shape and type.
        materials: What the groups stand for.
        unit: The length that 1 stands for, where the format or file says so.
        geometries: Which faces and vertices are one geometry, where they are kept apart.
        instances: Where geometries stand, there where `geometries` are.
    """

    positions: np.ndarray
    faces: np.ndarray
    notes: tuple[str, ...] = ()
    attributes: tuple[Attribute, ...] = ()
    materials: tuple[Material, ...] = ()
    unit: str | None = None
    geometries: Geometries | None = None
    instances: Instances | None = None


@dataclass(frozen=True, eq=False)
class Fans:
    """Polygons cut into fans from their first corner.

    Args:
        corners: `(f, 3)` int64: which corner of all polygons' each corner of a triangle is.
        polygons: `(f,)` int64: the polygon that each triangle is part of.
        notes: How many polygons were cut, how many had fewer than 3 corners and are left out.
    """

    corners: np.ndarray
    polygons: np.ndarray
    notes: tuple[str, ...]


def file_size(file: IO[bytes]) -> int:
    """The size of a seekable file in bytes; leaves it at its start."""
    size = file.seek(0, 2)
    file.seek(0)
    return size


def counted(number: int, one: str, many: str) -> str:
    """`1 n-gon` or `2 n-gons`."""
    return f"{number} {one if number == 1 else many}"


def fan_out(lengths: np.ndarray) -> Fans:
    """Cut polygons into fans, in file order.

    Args:
        lengths: `(p,)` corners of each polygon.
    """
    lengths = np.asarray(lengths, np.int64)
    triangles = np.maximum(lengths - 2, 0)
    polygon = np.repeat(np.arange(len(lengths)), triangles)
    first = (np.cumsum(lengths) - lengths)[polygon]
    step = np.arange(len(polygon)) - (np.cumsum(triangles) - triangles)[polygon]
    corners = np.stack([first, first + step + 1, first + step + 2], axis=1)
    cut, short = int(np.count_nonzero(lengths > 3)), int(np.count_nonzero(lengths < 3))
    notes = []
    if cut:
        made = int(triangles[lengths > 3].sum())
        notes.append(f"{counted(cut, 'n-gon', 'n-gons')} cut into {made} triangles")
    if short:
        notes.append(f"{counted(short, 'face', 'faces')} of fewer than 3 corners left out")
    return Fans(corners, polygon, tuple(notes))


def left_out(what: Sequence[str], one: str, many: str, most: int = 5) -> tuple[str, ...]:
    """`2 properties left out: weight, tag` as the one note; none where nothing was."""
    if not what:
        return ()
    more = ", ..." if len(what) > most else ""
    names = ", ".join(tidy_name(name)[:40] for name in what[:most])
    return (f"{counted(len(what), one, many)} left out: {names}{more}",)


def flatten(parts: Sequence[Parsed]) -> Parsed:
    """Put parts one after another into one mesh; positions stay float32 only where all parts are.

    Attributes are joined; materials are not, and groups are left to the caller.

    Raises:
        LimitError: Where the whole would have too many triangles or vertices.
    """
    total = sum(len(part.faces) for part in parts)
    vertices = sum(len(part.positions) for part in parts)
    if total > MOST_FACES or vertices > 2**31 - 1:
        raise LimitError(
            f"{total} triangles and {vertices} vertices after flattening",
            remedy=f"at most {MOST_FACES} triangles are handled",
        )
    if len(parts) == 1:
        return parts[0]
    offsets = np.cumsum([0, *(len(part.positions) for part in parts)])
    faces = [part.faces.astype(np.int64) + offset for part, offset in zip(parts, offsets, strict=False)]
    notes = tuple(note for part in parts for note in part.notes)
    if not parts:
        return Parsed(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), notes)
    attributes, lacking = join_attributes(
        [(len(part.positions), len(part.faces), part.attributes) for part in parts]
    )
    positions = np.concatenate([part.positions for part in parts])
    return Parsed(positions, np.concatenate(faces), notes + lacking, attributes)


def narrow(positions: np.ndarray) -> np.ndarray:
    """Positions read from text: float32 where that holds every one exactly, else float64 as they are."""
    with np.errstate(over="ignore", invalid="ignore"):
        small = positions.astype(np.float32)
    return small if ((small == positions) | np.isnan(positions)).all() else positions


def decode_text(data: bytes) -> bytes:
    """Text in UTF-8 with line feeds only: UTF-16 with a mark is converted; NUL bytes are refused."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = data.decode("utf-16").encode()
    if b"\0" in data:
        raise UnreadableMeshError("NUL bytes in a text file", remedy="is it really of this format?")
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").removeprefix(b"\xef\xbb\xbf")


def numbers(text: bytes, dtype: type = np.float64) -> np.ndarray:
    """All numbers of a text, which must hold nothing else.

    Raises:
        UnreadableMeshError: Where something in it is no number.
    """
    with strict_numbers():
        return np.fromstring(text.decode("ascii", "replace"), sep=" ", dtype=dtype)


@contextmanager
def strict_numbers() -> Iterator[None]:
    """Make NumPy's half-read texts and impossible casts an error, and other warnings of the block silent.

    A half-read text is a warning up to NumPy 2.3 and an error since.
    """
    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message="string or file could not be read")
            warnings.filterwarnings("error", message="invalid value encountered in cast")
            yield
    except (DeprecationWarning, RuntimeWarning, ValueError) as error:
        known = ("string or file could not be read", "could not convert string to float")
        if isinstance(error, ValueError) and not any(words in str(error) for words in known):
            raise
        raise UnreadableMeshError("text where a number should be", remedy=EXPORT_AGAIN) from error
