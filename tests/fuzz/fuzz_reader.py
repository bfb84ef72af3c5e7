"""Fuzz the readers of scene files: reader, validator and reference reader must say the same of any bytes.

Needs the extras dev and fuzz; from the root of the repository:

    python tests/fuzz/fuzz_reader.py [--keep FOLDER] [CORPUS] [-max_total_time=1800 and other libFuzzer flags]

The conformance vectors are the corpus to start with. The last byte of an input says what is made of it: a
file as it is, one whose checksums, or lengths and places too, are mended, so that mutations get behind them,
or changes of a few bytes of a valid vector. With `--keep` a finding is written to the folder, once for each
place where it comes up, and the run goes on.
"""

import hashlib
import pkgutil
import struct
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import atheris

from striptools import kernels

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

# Numba cannot compile what is instrumented, so kernels come first.
for module in pkgutil.iter_modules(kernels.__path__, "striptools.kernels."):
    import_module(module.name)
with atheris.instrument_imports(include=["striptools", "reader"]):
    from formats import VECTORS, agree, mended

__all__ = ["replaced", "watched"]


def replaced(data: bytes) -> bytes:
    """The bytes with magic, version, length, the places of sections and all checksums made to fit."""
    out = bytearray(data.ljust(32, b"\0"))
    out += bytes(-len(out) % 64)
    out[:12] = b"\x89RDM\r\n\x1a\n\0\0\3\0"
    count = min(max(1, out[12]), (len(out) - 32) // 40, 64)
    struct.pack_into("<IQI", out, 12, count, len(out), 0)
    end = 32 + 40 * count
    for at in range(32, 32 + 40 * count, 40):
        codec, _, stored, raw = struct.unpack_from("<HQQQ", out, at + 6)
        start = end + -end % 64
        room = max(len(out) - start, 1)
        stored = min(stored or 1, room)
        # The last section reaches to the end, so that the file ends where it must.
        if at + 40 == 32 + 40 * count and room - stored >= 64:
            stored = room
        struct.pack_into("<QQQ", out, at + 8, start, stored, raw if codec else stored)
        out[end:start] = bytes(start - end)
        end = start + stored
    if end < len(out):
        out[end:] = bytes(len(out) - end)
    return mended(bytes(out))


def edited(data: bytes) -> bytes:
    """A valid vector, by its number, with bytes changed, by places and values, and its checksums mended."""
    out = bytearray(VALID[data[0] % len(VALID)] if data else b"")
    for at in range(1, min(len(data) - 2, 25), 3):
        # The header's magic and version are left alone.
        place = 12 + int.from_bytes(data[at : at + 2], "little") % (len(out) - 12)
        out[place] = data[at + 2]
    return mended(bytes(out))


WAYS = (bytes, mended, replaced, edited)
VALID = [path.read_bytes() for path in sorted(VECTORS.glob("valid/*.rdm"))]


def look(data: bytes) -> None:
    """Judge what the last byte of an input says is to be made of it."""
    agree(WAYS[data[-1] % len(WAYS)](data[:-1]) if data else data)


def watched(folder: Path, check: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """The check, with what it finds written to a folder instead of raised."""
    seen: set[str] = set()
    folder.mkdir(parents=True, exist_ok=True)

    def run(data: bytes) -> None:
        try:
            check(data)
        except Exception as error:
            text = "".join(traceback.format_exception(error))
            frames = traceback.extract_tb(error.__traceback__)
            place = "".join(f"{Path(f.filename).name}:{f.lineno} " for f in frames) + str(error)[:90]
            if place not in seen and len(seen) < 500:
                seen.add(place)
                name = hashlib.sha256(data).hexdigest()[:16]
                (folder / f"{name}.rdm").write_bytes(data)
                (folder / f"{name}.txt").write_text(text)

    return run


def main() -> None:
    """Run libFuzzer on the vectors and what the command line names."""
    warnings.simplefilter("error")
    arguments = sys.argv[1:]
    check = look
    if arguments[:1] == ["--keep"]:
        check, arguments = watched(Path(arguments[1]), look), arguments[2:]
    with tempfile.TemporaryDirectory() as corpus:
        for path in VECTORS.glob("*valid/*.rdm"):
            for way in (1, 2):
                (Path(corpus) / f"{path.stem}-{way}").write_bytes(path.read_bytes() + bytes([way]))
        for number in range(len(VALID)):
            change = bytes([number, 20, 1, number, 80, 2, number, 3])
            (Path(corpus) / f"{number}-3").write_bytes(change)
        atheris.Setup([sys.argv[0], *arguments, "-max_len=4096", corpus], check)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
