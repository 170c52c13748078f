"""nuScenes' .pcd.bin: x, y, z (metres, sensor frame), intensity (0 to 255), ring; five float32 per return.

Returns are motion-compensated to the sweep's timestamp.
"""

from pathlib import Path

import numpy as np

from drivesplat.scene.sensors import LidarReturns

_COLUMNS = 5
_MAX_RING = 1e6


def read_file(path: Path) -> LidarReturns:
    """The returns with finite coordinates, of a file without a fault."""
    returns = np.fromfile(path, dtype=np.float32).reshape(-1, _COLUMNS)
    returns = returns[np.isfinite(returns[:, :3]).all(axis=1)]
    with np.errstate(invalid="ignore", over="ignore"):  # random bytes; `sweeps.read_returns` refuses them
        rings = np.nan_to_num(returns[:, 4], nan=-1.0).clip(-1.0, _MAX_RING).astype(np.int64)
        return LidarReturns(returns[:, :3].astype(np.float64), returns[:, 3] / 255.0, rings)


def file_fault(path: Path) -> str | None:
    """The fault of an existing file, or None."""
    size = path.stat().st_size
    if size == 0 or size % (4 * _COLUMNS):
        return f"is corrupt ({size} bytes are no whole number of returns)"
    return None
