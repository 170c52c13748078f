"""Whether the disk has room."""

from pathlib import Path

from drivesplat.errors import DatasetError
from drivesplat.io.free_disk import disk_of, free_bytes


def require_space(folder: Path, needed: int, what: str) -> None:
    """Raises DatasetError where the disk on which `folder` is, or will be, has less than `needed` bytes free."""
    free = free_bytes(folder)
    if free < needed:
        raise DatasetError(
            f"{what} needs {needed / 1e9:.1f} GB on the disk of {disk_of(folder)}, which has {free / 1e9:.1f} GB free: "
            "make room, or set a dataroot on another disk"
        )
