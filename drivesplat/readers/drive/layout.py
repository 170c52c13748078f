"""The location of drive folders: `dataroot` holds a folder for each scene, or is the folder of its only scene."""

import json
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

from drivesplat.errors import DatasetError
from drivesplat.readers.outline import Outline, RecordedCamera

FILE = "drive.json"
POSES_OPTIONAL = True
"""Whether drives may lack poses."""
MAX_HEADER = 2**14
"""Bytes of a PLY file that are searched for the names of its columns."""
HOW = "docs/own_data.md says how to write one; set datasets.<name>.dataroot to its folder, or to the one above"


def find_root(dataroot: str, version: str) -> Path:
    """The folder `dataroot`. Raises DatasetError where neither it nor a folder in it holds a drive.json."""
    root = Path(dataroot).expanduser()
    if not root.is_dir():
        raise DatasetError(f"drive folder not found: there is no folder {root}; {HOW}")
    if not (root / FILE).is_file() and not any(root.glob(f"*/{FILE}")):
        raise DatasetError(f"drive folder not found: looked for {FILE} in {root} and in the folders in it; {HOW}")
    return root


def scene_folder(root: Path, scene: str) -> Path:
    """The drive folder of a scene. Raises DatasetError with those there are."""
    inside = root / scene
    if (inside / FILE).is_file():
        return inside
    if (root / FILE).is_file():
        return root
    known = ", ".join(sorted(file.parent.name for file in root.glob(f"*/{FILE}")))
    raise DatasetError(f"scene {scene} is not in {root}; there are: {known or 'none'}")


def table_files(root: Path, version: str, scene: str) -> list[Path]:
    """The files from which `read` reads a scene."""
    return [scene_folder(root, scene) / FILE]


def camera_names(root: Path, version: str) -> list[str]:
    """The names of the cameras of all drive folders. Raises DatasetError where a drive.json is no drive."""
    names: dict[str, None] = {}
    for file in [root / FILE, *sorted(root.glob(f"*/{FILE}"))]:
        if file.is_file():
            try:
                names |= dict.fromkeys(_content(file, file.stat().st_mtime_ns).get("cameras", {}))
            except (AttributeError, OSError, RecursionError, TypeError, ValueError) as error:
                raise DatasetError(
                    f"{file} names no cameras ({type(error).__name__}: {str(error)[:200]}); "
                    f"`drivesplat check {file.parent}` lists all of its faults"
                ) from error
    return list(names)


def outline(root: Path, version: str, scene: str) -> Outline | None:
    """What a drive folder holds; None where its drive.json has faults, which `read` names."""
    file = scene_folder(root, scene) / FILE
    try:
        drive = _content(file, file.stat().st_mtime_ns)
        frames, sweeps = drive.get("frames") or [], drive.get("sweeps") or []
        images = Counter(frame["camera"] for frame in frames)
        first_sweeps = {sweep["lidar"]: file.parent / sweep["file"] for sweep in reversed(sweeps)}
        unknown = [
            name
            for name, first in first_sweeps.items()
            if drive["lidars"][name].get("beam_elevations") is None and not _has_rings(first)
        ]
        cameras = drive.get("cameras") or {}
        return Outline(
            cameras={name: RecordedCamera(of["width"], of["height"], images[name]) for name, of in cameras.items()},
            key_frames=sorted(_key_frames(drive, frames, sweeps)),
            sweeps=len(sweeps),
            without_beams=unknown,
        )
    except (AttributeError, KeyError, OSError, RecursionError, TypeError, ValueError):
        return None


@lru_cache(maxsize=256)
def _content(file: Path, _: int) -> Any:
    """The content of a file with a modification time."""
    return json.loads(file.read_text(encoding="utf-8"))


def _key_frames(drive: Any, frames: list[Any], sweeps: list[Any]) -> list[int]:
    """The times of key frames in microseconds, as `read` takes them."""
    if drive.get("key_frames") is not None:
        return drive["key_frames"]
    for camera in drive.get("cameras") or {}:
        of_camera = [frame for frame in frames if frame["camera"] == camera]
        if of_camera:
            return [frame["timestamp"] for frame in of_camera if frame.get("key_frame")] or [
                frame["timestamp"] for frame in of_camera
            ]
    lidar = next((name for name in drive["lidars"] if any(sweep["lidar"] == name for sweep in sweeps)), None)
    return [sweep["timestamp"] for sweep in sweeps if sweep["lidar"] == lidar]


def _has_rings(file: Path) -> bool:
    """Whether the returns of a sweep's file have rings; True for a file that cannot be read, which others report."""
    try:
        if file.suffix.lower() == ".npz":
            with ZipFile(file) as arrays:
                names = [name.removesuffix(".npy").encode() for name in arrays.namelist()]
        else:
            with open(file, "rb") as opened:
                header = opened.read(MAX_HEADER).partition(b"end_header")[0].partition(b"\nDATA")[0]
            lines = (line for line in header.splitlines() if line.startswith((b"property", b"FIELDS")))
            names = [name for line in lines for name in line.split()[1:]]
        return any(name.lower().removeprefix(b"scalar_") == b"ring" for name in names)
    except (BadZipFile, OSError):
        return True
