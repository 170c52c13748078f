"""The content of lidar_depth.npz: sparse LiDAR depth of every training image.

The stage `lidar_depth` writes it (`drivesplat.preprocess.lidar_depth`).
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from drivesplat.io.array_file import read_typed_arrays
from drivesplat.io.storage import Provenance, no_provenance

RULE = "lidar_depth"


@dataclass(frozen=True)
class PixelDepths:
    """Depths of m distinct pixels of an image: `depth` in metres along the optical axis at `rows` and `columns`."""

    rows: Int[np.ndarray, " m"]
    columns: Int[np.ndarray, " m"]
    depth: Float[np.ndarray, " m"]

    def fault(self) -> str | None:
        """What no record of `lidar_depth` holds, None without a fault."""
        sound = (self.depth > 0.0).all() and (self.rows >= 0).all() and (self.columns >= 0).all()
        return None if sound else "it has depths or pixels that are not positive"

    def __len__(self) -> int:
        return len(self.depth)


@dataclass(frozen=True)
class LidarDepthRecord:
    """The content of lidar_depth.npz: `images` in the order of the scene's frames, at training size, empty for frames
    that are not training images."""

    images: list[PixelDepths]
    provenance: Provenance = field(default_factory=no_provenance)


def read_lidar_depth(path: str | Path) -> LidarDepthRecord:
    """Reads lidar_depth.npz. Raises ResultError, naming the file and its rule, if it is invalid."""
    return read_typed_arrays(path, RULE, LidarDepthRecord, "depths")
