"""What free_space.pkl holds: the voxels that rays prove empty.

    lower       (3,) float64: the grid's lower corner in world metres
    voxel       edge of a voxel in metres
    shape       (3,) int64: how many voxels the grid has along x, y and z
    keys        (k,) int64, ascending: the empty voxels; voxel i, j, k of the grid is (i ny + j) nz + k
    provenance

The stage `free_space` makes it (`drivesplat.preprocess.free_space`).
"""

from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.io.plain_pickle import read_plain_pickle
from drivesplat.io.storage import unreadable


def read_free_space(path: str | Path) -> dict[str, Any]:
    """Reads free_space.pkl. Raises ResultError, naming the file and the rule that makes it, where it is not one."""
    content = read_plain_pickle(path, rule="free_space")
    try:
        if not content.keys() >= {"lower", "voxel", "shape", "keys", "provenance"}:
            raise ValueError("it lacks the keys of one")
        if not (content["lower"].shape == content["shape"].shape == (3,) and content["voxel"] > 0):
            raise ValueError("it describes no grid")
        keys = content["keys"]
        if keys.dtype != np.int64 or keys.ndim != 1 or (np.diff(keys) <= 0).any():
            raise ValueError("its voxels are in no order")
    except (AttributeError, TypeError, ValueError) as error:
        raise unreadable(path, "free_space", f"not a record of free space ({error})") from error
    return content
