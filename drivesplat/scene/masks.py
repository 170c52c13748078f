"""The masks of a scene, as files: region labels, sky and semantic classes of every image."""

from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.io.storage import read_record, unreadable
from drivesplat.scene.images import read_mask

UNLABELLED = 255
"""The value of pixels that a user's map of classes says nothing of."""


def mask_name(kind: str, camera: str, timestamp: int) -> str:
    """The path of a mask below the masks folder; `kind` is 'regions', 'sky' or 'semantic'."""
    return f"{kind}/{camera}/{timestamp}.png"


def read_masks_record(folder: Path) -> dict[str, Any]:
    """Reads `masks.json`. Raises ResultError where it is not one."""
    return read_record(folder / "masks.json", "masks", "regions", "sky_known", "semantic_classes", "own_car")


def read_sky_mask(folder: Path, camera: str, timestamp: int, size: tuple[int, int]) -> np.ndarray:
    """The sky (h, w) bool of an image at `size` (width, height).

    Raises ResultError where the mask is missing or unreadable.
    """
    return _made_mask(folder, "sky", camera, timestamp, size) > 127


def read_labels(folder: Path, camera: str, timestamp: int, size: tuple[int, int]) -> np.ndarray:
    """The label image (h, w) of an image at `size` (width, height).

    Raises ResultError where it is missing or unreadable.
    """
    return _made_mask(folder, "regions", camera, timestamp, size)


def read_classes(folder: Path, camera: str, timestamp: int, size: tuple[int, int]) -> np.ndarray:
    """The user's classes (h, w) of an image at `size` (width, height), UNLABELLED where there is none.

    Raises ResultError where they are missing or unreadable.
    """
    return _made_mask(folder, "semantic", camera, timestamp, size)


def _made_mask(folder: Path, kind: str, camera: str, timestamp: int, size: tuple[int, int]) -> np.ndarray:
    path = folder / mask_name(kind, camera, timestamp)
    try:
        return read_mask(path, size)
    except DatasetError as error:
        raise unreadable(path, "masks", str(error), delete=folder / "masks.json") from error
