"""Sweeps of drive folders: .npz with arrays, .ply with vertex properties, or .pcd with fields, called x, y, z (metres,
in the sensor's frame at the sweep's timestamp) and, where known, intensity (0 to 1), ring (index of the beam) and time
(seconds after the sweep's timestamp).

Other programs' names for them are known, too: capitals, CloudCompare's prefix scalar_, and reflectance for intensity.
Such intensities, and those of .pcd files, count to 255 where one is beyond 1, or their type has 8 bits.
"""

import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyElementParseError, PlyHeaderParseError

from drivesplat.io.pcd import header_of, read_pcd
from drivesplat.io.point_cloud import read_ply_data
from drivesplat.io.regular_file import regular_file
from drivesplat.readers.sweep_motion import TOLERANCE_S, motion_fault
from drivesplat.scene.scene import Sweep
from drivesplat.scene.sensors import LidarReturns

AXES = ("x", "y", "z")
OPTIONAL = ("intensity", "ring", "time")
SUFFIXES = (".npz", ".ply", ".pcd")
MAX_RINGS = 10_000
BYTE = 255.0
"""The intensity that is 1 where intensities are those of other programs and beyond 1."""


def read_file(path: Path) -> LidarReturns | str:
    """The returns with finite coordinates of an existing file, or its fault. `drivesplat.readers.sweeps` checks the
    returns, as for all readers."""
    if path.suffix.lower() not in SUFFIXES:
        return f"is no sweep that can be read: sweeps are {', '.join(SUFFIXES)} files (docs/own_data.md)"
    try:
        columns = _columns(path)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, PlyHeaderParseError, PlyElementParseError) as error:
        return f"is corrupt ({' '.join(str(error).split())[:200]})"
    lengths = {len(values) for values in columns.values()}
    if len(lengths) != 1:
        return f"is corrupt (its columns have {', '.join(map(str, sorted(lengths)))} rows)"
    if not lengths.pop():
        return "is empty"
    intensity = columns.get("intensity")
    if intensity is not None and ((intensity < 0) | (intensity > 1)).any():
        return f"has intensities up to {float(np.nanmax(intensity)):.3g}; divide them, so that they lie in [0, 1]"
    ring = columns.get("ring")
    if ring is not None and not ((ring >= -1) & (ring < MAX_RINGS)).all():
        return f"has rings from {np.nanmin(ring):g} to {np.nanmax(ring):g}; they are indices of beams, from 0 on"
    points = np.stack([columns[name] for name in AXES], axis=1).astype(np.float64)
    finite = np.isfinite(points).all(axis=1)
    optional: dict[str, Any] = {name: columns[name][finite] for name in OPTIONAL if name in columns}
    intensity, ring, time = (optional.get(name) for name in OPTIONAL)
    return LidarReturns(
        points[finite],
        None if intensity is None else intensity.astype(np.float32),
        None if ring is None else ring.astype(np.int64),
        None if time is None else time.astype(np.float64),
    )


def beyond_poses(sweep: Sweep, reach: int) -> str | None:
    """Why a sweep at the end of the ego poses cannot be motion-compensated, although its points are within `reach`
    (microseconds) of its timestamp; None for all others. Reads the files of those near an end alone."""
    assert sweep.motion is not None
    known = np.rint(sweep.motion.offsets_s[[0, -1]] * 1e6)
    path = Path(sweep.path)
    if (known[0] <= -reach and known[1] >= reach) or not path.is_file():
        return None
    returns = read_file(path)
    if isinstance(returns, str) or returns.offsets_s is None:
        return None
    if not (np.abs(returns.offsets_s) <= reach * 1e-6 + TOLERANCE_S).all():
        return None
    return motion_fault(returns, sweep.motion)


def columns_sentence(path: Path) -> str:
    """What the columns of a file without a fault are read as, and what is not used, as the end of a sentence."""
    columns, names = _read(path)
    known = _sources(names)
    found = [name if name == source else f"{name} ({source})" for name, source in known.items()]
    unused = [name for name in names if name not in known.values()]
    if path.suffix.lower() == ".pcd" and header_of(path).moved:
        unused.append("the VIEWPOINT")
    scaled = "intensity" in known and _counts_to_byte(path, known["intensity"], columns[known["intensity"]])
    return (
        f"has {', '.join(found)}{', whose intensities are divided by 255' if scaled else ''}"
        f"{'; not used: ' + ', '.join(unused) if unused else ''}"
    )


def _sources(names: Iterable[str]) -> dict[str, str]:
    """The names in a file, by what they are read as: a column of exactly that name, or the first that is alike."""
    sources: dict[str, str] = {}
    for name in names:
        plain = name.lower().removeprefix("scalar_")
        known = "intensity" if plain == "reflectance" else plain
        if known in (*AXES, *OPTIONAL) and (known not in sources or name == known):
            sources[known] = name
    return {name: sources[name] for name in (*AXES, *OPTIONAL) if name in sources}


def _columns(path: Path) -> Mapping[str, np.ndarray]:
    """The known columns of a file as flat arrays. Raises ValueError for one that lacks a coordinate."""
    every, names = _read(path)
    sources = _sources(names)
    found = {name: every[source] for name, source in sources.items()}
    lacking = [name for name in AXES if name not in found]
    if lacking:
        raise ValueError(f"it has no {', '.join(lacking)}; its columns are {', '.join(names) or 'none'}")
    wrong = [name for name, values in found.items() if values.ndim != 1 or values.dtype.kind not in "fiu"]
    if wrong:
        raise ValueError(f"{', '.join(wrong)} is no column of numbers")
    if "intensity" in found and _counts_to_byte(path, sources["intensity"], found["intensity"]):
        found["intensity"] = found["intensity"] / BYTE
    return found


def _counts_to_byte(path: Path, source: str, values: np.ndarray) -> bool:
    """Whether intensities from the column `source` count to 255 instead of 1."""
    foreign = source != "intensity" or path.suffix.lower() == ".pcd"
    return foreign and (values.dtype.itemsize == 1 or bool((values > 1).any()))


def _read(path: Path) -> tuple[Mapping[str, np.ndarray], list[str]]:
    """The columns of a file, and their names in its order. Of .npz files only the known ones are read."""
    if path.suffix.lower() == ".npz":
        with np.load(regular_file(path), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in _sources(arrays.files).values()}, arrays.files
    if path.suffix.lower() == ".pcd":
        columns = read_pcd(regular_file(path))
        return columns, list(columns)
    vertices = read_ply_data(path)["vertex"].data
    return {name: np.asarray(vertices[name]) for name in vertices.dtype.names}, list(vertices.dtype.names)
