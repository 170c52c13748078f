"""Coloured points as PLY files, with a JSON note on their origin in the header."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from drivesplat.io.storage import atomic_write, canonical_json, unreadable
from drivesplat.io.typed_record import require_finite

_NOTE = "drivesplat "


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
        data = PlyData.read(str(path))
        note = next(json.loads(c.removeprefix(_NOTE)) for c in data.comments if c.startswith(_NOTE))
        vertices = data["vertex"]
        positions = _columns(vertices, ("x", "y", "z"), "f4")
        require_finite("its positions", positions)
        return PointCloud(positions, _columns(vertices, ("red", "green", "blue"), "u1"), note)
    except (OSError, PlyParseError, KeyError, ValueError, StopIteration) as error:
        raise unreadable(path, rule, f"not a seed of this workflow ({error or type(error).__name__})") from error


def read_positions(path: str | Path) -> np.ndarray:
    """The vertex positions (n, 3) float64 of any PLY file.

    Raises OSError, PlyParseError, KeyError or ValueError where the file is not one.
    """
    return _columns(PlyData.read(str(path))["vertex"], ("x", "y", "z"), "f8")


def _columns(vertices: PlyElement, names: tuple[str, ...], dtype: str) -> np.ndarray:
    return np.stack([np.asarray(vertices[name]) for name in names], axis=1).astype(dtype)
