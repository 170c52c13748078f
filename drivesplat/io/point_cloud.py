"""Coloured points as PLY files, with a JSON note on their origin in the header."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from drivesplat.io.regular_file import regular_file
from drivesplat.io.storage import atomic_write, canonical_json, unreadable
from drivesplat.io.typed_record import require_finite

_NOTE = "drivesplat "
MAX_HEADER_BYTES = 1_000_000
"""plyfile reads a header byte by byte: a comment of 100 MB would take minutes."""


@dataclass(frozen=True)
class PointCloud:
    """`positions` (n, 3) float32 metres; `colors` (n, 3) uint8 RGB; `note`: plain data on their origin."""

    positions: np.ndarray
    colors: np.ndarray
    note: dict[str, Any] = field(default_factory=dict)


def write_ply(path: str | Path, points: PointCloud) -> None:
    names = ("x", "y", "z", "red", "green", "blue")
    columns = (*points.positions.T.astype(np.float32), *points.colors.T.astype(np.uint8))
    write_vertices(path, dict(zip(names, columns, strict=True)), points.note)


def write_vertices(path: str | Path, columns: Mapping[str, np.ndarray], note: Mapping[str, Any]) -> None:
    """Writes vertices with a property for each of `columns`, (n,) in its own type, and the note."""
    vertices = np.rec.fromarrays([*columns.values()], dtype=[(name, c.dtype) for name, c in columns.items()])
    element = PlyElement.describe(vertices, "vertex")
    with atomic_write(path) as file:
        PlyData([element], byte_order="<", comments=[_NOTE + canonical_json(note)]).write(file)


def read_ply(path: str | Path, rule: str) -> PointCloud:
    """Reads a file of `write_ply`. Raises ResultError naming the file and its `rule` where it is missing or invalid."""
    try:
        data = read_ply_data(path)
        note = next(json.loads(c.removeprefix(_NOTE)) for c in data.comments if c.startswith(_NOTE))
        vertices = data["vertex"]
        positions = _columns(vertices, ("x", "y", "z"), "f4")
        require_finite("its positions", positions)
        return PointCloud(positions, _columns(vertices, ("red", "green", "blue"), "u1"), note)
    except (OSError, PlyParseError, KeyError, ValueError, StopIteration) as error:
        raise unreadable(path, rule, f"not a seed of this workflow ({error or type(error).__name__})") from error


def read_ply_data(path: str | Path) -> PlyData:
    """The content of any PLY file. Raises OSError, PlyParseError or ValueError where the file is not one."""
    with open(regular_file(path), "rb") as file:
        header = file.read(MAX_HEADER_BYTES)
    newline = b"\r\n" if header[3:5] == b"\r\n" else header[3:4]
    if header.startswith(b"ply") and newline + b"end_header" + newline not in header:
        raise ValueError(f"its header has no end_header within {MAX_HEADER_BYTES / 1e6:g} MB")
    try:
        return PlyData.read(str(path))
    except (MemoryError, OverflowError) as error:
        raise ValueError(f"its header announces more than can be read: {error}") from error


def read_positions(path: str | Path) -> np.ndarray:
    """The vertex positions (n, 3) float64 of any PLY file.

    Raises OSError, PlyParseError, KeyError or ValueError where the file is not one.
    """
    return _columns(read_ply_data(path)["vertex"], ("x", "y", "z"), "f8")


def _columns(vertices: PlyElement, names: tuple[str, ...], dtype: str) -> np.ndarray:
    return np.stack([np.asarray(vertices[name]) for name in names], axis=1).astype(dtype)
