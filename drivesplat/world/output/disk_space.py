"""The size of a world, compared with the free space before it is made."""

import shutil
from pathlib import Path

from drivesplat.errors import ResultError
from drivesplat.settings.world import WorldSettings
from drivesplat.world.optics.rig import image_height

JPEG_BYTES, TRUTH_BYTES, CLASS_BYTES = 0.45, 2.6, 0.06
"""Bytes per pixel: of an image, of all images of a true view, of the class and sky maps of an image."""
SWEEP_BYTES, SCAN_BYTES = 600_000, 250_000
"""Bytes of a sweep of 32 beams, and of its truth."""


def world_bytes(world: WorldSettings, images: int, sweeps: int, views: int, scans: int) -> int:
    """The approximate size in bytes of a world of so many images and sweeps, and of true views and scans, which are
    written for each key frame."""
    pixels, rays = world.width * image_height(world.width), world.lidar.beams / 32
    per_image = JPEG_BYTES + (CLASS_BYTES if world.class_maps else 0.0)
    recorded = images * pixels * per_image + sweeps * SWEEP_BYTES * rays
    return round(recorded + world.key_frames * (views * pixels * TRUTH_BYTES + scans * SCAN_BYTES * rays))


def require_space(root: Path, needed: int) -> None:
    """Raises ResultError, one line, where the file system of `root` has less free space than `needed` bytes."""
    free = shutil.disk_usage(root).free
    if needed > free:
        raise ResultError(
            f"{root}: the world takes about {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free; free some space, set "
            "another datasets.<name>.dataroot, or make the world smaller (width, key_frames, cameras)"
        )
