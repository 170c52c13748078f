"""The content of free_space.npz: the voxels that rays prove empty.

The stage `free_space` writes it (`drivesplat.preprocess.free_space`).
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64

from drivesplat.io.array_file import read_typed_arrays
from drivesplat.io.storage import Provenance, no_provenance

RULE = "free_space"


@dataclass(frozen=True)
class FreeSpace:
    """Empty voxels of a grid whose lower corner is `lower` in world metres.

    `voxel` is the edge of a voxel in metres, `shape` the number of voxels along x, y and z. `keys` are the empty voxels
    in ascending order; the key of voxel (i, j, k) is (i ny + j) nz + k.
    """

    lower: Float[np.ndarray, "3"]
    shape: Int64[np.ndarray, "3"]
    voxel: float
    keys: Int64[np.ndarray, " k"]
    provenance: Provenance = field(default_factory=no_provenance)

    def fault(self) -> str | None:
        """What no record of `free_space` holds, None without a fault."""
        return None if self.voxel > 0 and (np.diff(self.keys) > 0).all() else "its voxels are not in order"


def read_free_space(path: str | Path) -> FreeSpace:
    """Reads free_space.npz. Raises ResultError, naming the file and its rule, if it is invalid."""
    return read_typed_arrays(path, RULE, FreeSpace, "free space")
