"""Point clouds as PCD files of the Point Cloud Library, version 0.7 and earlier: ascii, binary and binary_compressed.

https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

MAX_HEADER_BYTES = 20_000
MAX_COLUMNS = 1000
TYPES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
"""Sizes in bytes of numbers, by their type."""


class Header(NamedTuple):
    """The header of a PCD file: `columns` (name, type of numpy, values per point), the number of `points`, how their
    `data` is stored and the byte at which it begins, and whether `moved`: it has a viewpoint other than the origin."""

    columns: list[tuple[str, np.dtype, int]]
    points: int
    data: str
    begin: int
    moved: bool


def read_pcd(path: Path) -> dict[str, np.ndarray]:
    """The columns (n,) of a PCD file by their names, without those of several values per point. The viewpoint is not
    applied. Raises OSError, and ValueError with the fault as a sentence."""
    header, content = header_of(path), path.read_bytes()
    body = memoryview(content)[header.begin :]
    sizes = [kind.itemsize * count for _, kind, count in header.columns]
    if header.data == "ascii":
        per_point = sum(count for _, _, count in header.columns)
        words = bytes(body).split()
        if len(words) != header.points * per_point:
            raise ValueError(
                f"its {header.points} points of {per_point} values take {header.points * per_point} numbers, and it "
                f"has {len(words)}"
            )
        values = np.array(words, dtype=np.float64).reshape(header.points, per_point)
        firsts = np.cumsum([0, *(count for _, _, count in header.columns)])
        return {
            name: values[:, first]
            for (name, _, count), first in zip(header.columns, firsts[:-1], strict=True)
            if count == 1
        }
    expected = header.points * sum(sizes)
    if header.data == "binary_compressed":
        body = memoryview(_decompressed(body, expected))
    if len(body) < expected:
        raise ValueError(f"its {header.points} points take {expected} bytes, and it has {len(body)}")
    begins = np.cumsum([0, *sizes[:-1]])
    if header.data == "binary":
        records = np.frombuffer(body[:expected], dtype=np.uint8).reshape(header.points, sum(sizes))
        parts = [records[:, begin : begin + size] for begin, size in zip(begins, sizes, strict=True)]
    else:  # field by field
        parts = [
            np.frombuffer(body[header.points * begin : header.points * (begin + size)], dtype=np.uint8)
            for begin, size in zip(begins, sizes, strict=True)
        ]
    return {
        name: np.frombuffer(part.tobytes(), dtype=kind)
        for (name, kind, count), part in zip(header.columns, parts, strict=True)
        if count == 1
    }


def header_of(path: Path) -> Header:
    """The header of a PCD file. Raises OSError, and ValueError with its fault as a sentence."""
    with open(path, "rb") as file:
        content = file.read(MAX_HEADER_BYTES)
    entries: dict[str, list[str]] = {}
    begin = 0
    while "DATA" not in entries:
        end = content.find(b"\n", begin)
        if end < 0:
            raise ValueError(f"it has no line DATA within its first {MAX_HEADER_BYTES} bytes")
        words = content[begin:end].decode("ascii", "replace").split()
        begin = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []
    sizes, types = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT") or ["1"] * len(names)
    if not 0 < len(names) <= MAX_COLUMNS or not len(names) == len(sizes) == len(types) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT of its header do not have the same number of entries")
    columns = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if _whole(size, "SIZE") not in TYPES.get(kind, ()):
            raise ValueError(f"its column {name[:80]} has the type {kind[:8]} of {size[:8]} bytes, which PCD lacks")
        columns.append((name, np.dtype(f"<{kind.lower()}{int(size)}"), _whole(count, "COUNT")))
    single = [name for name, _, count in columns if count == 1 and name != "_"]
    if len(set(single)) < len(single):
        raise ValueError("two of its columns have one name")
    width, height = (_whole(entries.get(key, ["1"])[:1], key) for key in ("WIDTH", "HEIGHT"))
    points = _whole(entries.get("POINTS", [str(width * height)])[:1], "POINTS")
    if "WIDTH" in entries and width * height != points:
        raise ValueError(f"its header has {points} points, and {width} x {height} of them")
    data = " ".join(entries["DATA"])
    if data not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"its DATA is {data[:80]!r}; known are ascii, binary and binary_compressed")
    moved = [float(word) for word in entries.get("VIEWPOINT", [])] not in ([], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    return Header(columns, points, data, begin, moved)


def _whole(words: str | list[str], key: str) -> int:
    """A count of the header."""
    word = words if isinstance(words, str) else " ".join(words)
    if not (word.isascii() and word.isdigit() and len(word) <= 10):
        raise ValueError(f"{key} of its header is {word[:80]!r}; it must be a whole number")
    return int(word)


def _decompressed(body: memoryview, expected: int) -> bytes:
    """The bytes of data compressed with LZF (Lehmann, liblzf), of the `expected` number, after its two sizes."""
    if len(body) < 8:
        raise ValueError("its compressed data is cut off")
    packed, size = (int(value) for value in np.frombuffer(body[:8], dtype="<u4"))
    if size != expected:
        raise ValueError(f"its points take {expected} bytes, and its compressed data holds {size}")
    source = bytes(body[8 : 8 + packed])
    if len(source) < packed:
        raise ValueError(f"its compressed data is cut off after {len(source)} of {packed} bytes")
    found, at = bytearray(), 0
    try:
        while at < packed and len(found) <= size:
            control, at = source[at], at + 1
            if control < 32:  # bytes as they are
                found += source[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length, at = length + source[at], at + 1
            back, at = ((control & 31) << 8) + source[at] + 1, at + 1
            begin, length = len(found) - back, length + 2
            if begin < 0:
                raise ValueError("its compressed data refers to what is before its beginning")
            while length > 0:  # may repeat what it has just written
                piece = found[begin : begin + min(length, back)]
                found += piece
                begin, length = begin + len(piece), length - len(piece)
    except IndexError as error:
        raise ValueError("its compressed data is cut off") from error
    if len(found) != size:
        raise ValueError(f"its compressed data gives {len(found)} bytes instead of {size}")
    return bytes(found)
