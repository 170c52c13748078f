"""Whether the disk has room."""

import shutil
from pathlib import Path

from drivesplat.errors import DatasetError


def require_space(folder: Path, needed: int, what: str) -> None:
    """Raises DatasetError where the disk on which `folder` is, or will be, has less than `needed` bytes free."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if free < needed:
        raise DatasetError(
            f"{what} needs {needed / 1e9:.1f} GB on the disk of {place}, which has {free / 1e9:.1f} GB free: make "
            "room, or set a dataroot on another disk"
        )
