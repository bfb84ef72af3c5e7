"""Walk tables whose rows hold lists, such as those of a PLY file, without trusting their lengths."""

import numpy as np

from striptools.kernels.compiled import helper, kernel


@helper
def read_integer(stream, place, width, big_endian, signed):
    """The integer of `width` bytes at `place`; unsigned ones of 8 bytes saturate."""
    value = np.uint64(0)
    for k in range(width):
        byte = stream[place + k] if big_endian else stream[place + width - 1 - k]
        value = (value << np.uint64(8)) | np.uint64(byte)
    if signed and width < 8 and value >> np.uint64(8 * width - 1):
        return np.int64(value) - (np.int64(1) << np.int64(8 * width))
    if not signed and value >> np.uint64(63):
        return np.int64(0x7FFFFFFFFFFFFFFF)
    return np.int64(value)


@kernel
def walk_bytes(stream, place, rows, layout, big_endian, target, starts, lengths):
    """Walk `rows` binary rows; note where the list of column `target` begins in each, and its length.

    Args:
        stream: Bytes.
        place: Where the first row begins.
        rows: How many rows there should be.
        layout: `(columns, 3)` int64: bytes of an entry; bytes of a list's length, 0 for no list; whether it
            is signed.
        big_endian: The byte order of the lengths.
        target: The column asked for, or -1.
        starts: `(rows,)` int64 to fill, where `target >= 0`.
        lengths: The same for the lengths.

    Returns:
        Where the next row would begin, and the first row that does not fit or has a negative length, or -1.
    """
    for row in range(rows):
        for column in range(layout.shape[0]):
            entries = np.int64(1)
            if layout[column, 1] > 0:
                # Read the length, provided it is there.
                if layout[column, 1] > stream.shape[0] - place:
                    return place, row
                entries = read_integer(stream, place, layout[column, 1], big_endian, layout[column, 2] != 0)
                place += layout[column, 1]

            # Step over the entries, provided they are there.
            if entries < 0 or entries > (stream.shape[0] - place) // layout[column, 0]:
                return place, row
            if column == target:
                starts[row] = place
                lengths[row] = entries
            place += entries * layout[column, 0]
    return place, -1


@kernel
def walk_numbers(stream, place, rows, lists, target, starts, lengths):
    """The same for rows of numbers in a float64 array; `lists` says which columns are lists."""
    for row in range(rows):
        for column in range(lists.shape[0]):
            entries = 1.0
            if lists[column]:
                # Read the length, provided it is there.
                if place >= stream.shape[0]:
                    return place, row
                entries = stream[place]
                place += 1

            # Step over the entries, provided they are there and the length is a whole number.
            if not (entries >= 0.0 and entries <= stream.shape[0] - place and entries == np.floor(entries)):
                return place, row
            if column == target:
                starts[row] = place
                lengths[row] = np.int64(entries)
            place += np.int64(entries)
    return place, -1


@kernel
def gather_runs(stream, starts, lengths):
    """Copy the runs `stream[starts[k] : starts[k] + lengths[k]]` one after another."""
    total = np.int64(0)
    for k in range(lengths.shape[0]):
        total += lengths[k]
    out = np.empty(total, stream.dtype)
    place = 0
    for k in range(lengths.shape[0]):
        for i in range(lengths[k]):
            out[place] = stream[starts[k] + i]
            place += 1
    return out
