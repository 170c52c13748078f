"""Class and sky maps of recorded images, in the format of masks.semantic_folder and masks.sky_folder."""

from pathlib import Path, PurePosixPath

import numpy as np

from drivesplat.scene.images import write_png
from drivesplat.world.shapes.mesh import SurfaceClass

SEMANTIC, SKY = "semantic", "sky"
"""Folders below the dataset's root."""
UNLABELLED = 255


def write_class_maps(root: Path, camera: str, image: str, classes: np.ndarray) -> None:
    """Writes the maps of an image from its `classes` (h, w). The sky is 255 in its map and unlabelled in the class map:
    it has no Gaussians."""
    sky, name = classes == SurfaceClass.SKY, f"{camera}/{PurePosixPath(image).stem}.png"
    write_png(root / SKY / name, np.where(sky, 255, 0).astype(np.uint8))
    write_png(root / SEMANTIC / name, np.where(sky, UNLABELLED, classes).astype(np.uint8))
