"""Whether a folder is a drive folder or holds some, for the check of recordings."""

from collections.abc import Iterator
from pathlib import Path

from drivesplat.readers.drive.layout import FILE
from drivesplat.readers.recognised import Recognised
from drivesplat.settings.names import require_name

FORMAT, SIGN, PAGE = "drive folder", FILE, "docs/own_data.md"
NAMELESS = "drive"
"""The scene of a folder whose name cannot be that of a scene."""


def recognised(folder: Path) -> Iterator[Recognised]:
    """The drive folder that a folder is, or else those in it."""
    if (folder / FILE).is_file():
        yield Recognised(folder.absolute(), "", (scene_name(folder),), folder / FILE)
    elif files := sorted(folder.glob(f"*/{FILE}")):
        yield Recognised(folder.absolute(), "", tuple(file.parent.name for file in files), files[0])


def scene_name(folder: Path) -> str:
    """The name of the scene of a drive folder: that of the folder, NAMELESS where it cannot name one."""
    name = folder.absolute().name
    try:
        require_name(name, "scene")
    except ValueError:
        return NAMELESS
    return name
