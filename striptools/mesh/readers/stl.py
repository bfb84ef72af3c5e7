"""STL, binary and ASCII, through trimesh; its header and its facets are checked before.

Left to itself trimesh regroups the vertices of facets that have more or fewer than three, drops a solid that
has no end without a word, and takes the word `vertex` in a solid's name for one.
"""

from __future__ import annotations

import re
from io import BytesIO
from typing import IO

import numpy as np

from striptools.errors import UnreadableMeshError
from striptools.mesh.readers.parsed import (
    EXPORT_AGAIN,
    Parsed,
    counted,
    decode_text,
    file_size,
    flatten,
    narrow,
    strict_numbers,
)

HEADER = 84
FACET = 50
NAME = re.compile(rb"^[ \t]*(end)?solid\b.*$", re.MULTILINE | re.IGNORECASE)
# A vertex counts only with three words behind it and then another vertex or the end of the loop.
KEYWORD = re.compile(
    rb"\b(endfacet|facet|vertex(?=(?:[ \t]+\S+){3}\s+(?:vertex|endloop)\b))\b", re.IGNORECASE
)
ONE_FACET = [b"facet", b"vertex", b"vertex", b"vertex", b"endfacet"]


def read_stl(file: IO[bytes]) -> Parsed:
    """Read an STL file of either kind; its vertices are three a triangle, as they stand.

    Raises:
        UnreadableMeshError: Where the size does not fit the count, or a facet is no triangle.
    """
    size = file_size(file)
    start = file.read(HEADER)
    announced = int.from_bytes(start[80:84], "little")
    needed = HEADER + FACET * announced
    is_text = start.lstrip()[:5].lower() == b"solid" and b"\0" not in start
    if len(start) == HEADER and size >= needed and not is_text:
        return _read_binary(file, needed, size - needed)
    file.seek(0)
    if not is_text:
        raise UnreadableMeshError(
            f"{size} bytes do not hold the {announced} triangles that the STL header announces"
            if len(start) == HEADER
            else f"{size} bytes are too few for an STL file",
            remedy="the file is cut short or no STL file",
        )
    return _read_text(file.read())


def _read_binary(file: IO[bytes], needed: int, spare: int) -> Parsed:
    from trimesh.exchange.stl import load_stl

    file.seek(0)
    # trimesh takes a file with bytes behind the last triangle for text.
    with strict_numbers():
        found = load_stl(BytesIO(file.read(needed)) if spare else file)
    notes = (f"{counted(spare, 'byte', 'bytes')} after the last triangle ignored",) if spare else ()
    file.seek(0)
    words = np.frombuffer(file.read(needed), np.uint8)[HEADER:].reshape(-1, FACET)[:, -2:]
    used = int(np.count_nonzero(words.any(axis=1)))
    if used:
        notes += (f"the attribute bytes of {counted(used, 'facet', 'facets')} left out",)
    if "vertices" not in found:
        return Parsed(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), notes)
    return Parsed(found["vertices"], found["faces"], notes)


def _read_text(data: bytes) -> Parsed:
    from trimesh.exchange.stl import load_stl_ascii

    text = NAME.sub(_without_name, decode_text(data))
    solids = re.findall(rb"^(?:end)?solid$", text, re.MULTILINE)
    if solids != [b"solid", b"endsolid"] * (len(solids) // 2):
        raise UnreadableMeshError("the STL file has a solid without an end", remedy="the file is cut short")
    words = [word.lower() for word in KEYWORD.findall(text)]
    facets = words.count(b"facet")
    if words != ONE_FACET * facets:
        place = next(k for k, word in enumerate(words) if word != ONE_FACET[k % 5])
        raise UnreadableMeshError(f"facet {place // 5} of the STL file is no triangle", remedy=EXPORT_AGAIN)
    with strict_numbers():
        found = load_stl_ascii(BytesIO(text))
    solids = [found] if "vertices" in found else list(found["geometry"].values())
    parts = [Parsed(solid["vertices"], solid["faces"]) for solid in solids]
    whole = flatten(parts)
    notes = (f"{len(parts)} solids flattened into one mesh",) if len(parts) > 1 else ()
    return Parsed(narrow(whole.positions), whole.faces, notes)


def _without_name(line: re.Match[bytes]) -> bytes:
    return b"endsolid" if line.group(1) else b"solid"
