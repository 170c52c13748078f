"""The location of drive folders: `dataroot` holds a folder for each scene, or is the folder of its only scene."""

import json
from pathlib import Path

from drivesplat.errors import DatasetError

FILE = "drive.json"
POSES_OPTIONAL = True
"""Whether drives may lack poses."""
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
                names |= dict.fromkeys(json.loads(file.read_text(encoding="utf-8")).get("cameras", {}))
            except (AttributeError, OSError, RecursionError, TypeError, ValueError) as error:
                raise DatasetError(
                    f"{file} names no cameras ({type(error).__name__}: {str(error)[:200]}); "
                    f"`python -m drivesplat.readers.drive check {file.parent}` lists all of its faults"
                ) from error
    return list(names)
