"""nuScenes' .pcd.bin: x, y, z (metres, sensor frame), intensity (0 to 255), ring; five float32 per return.

Points are motion-compensated to the sweep's timestamp, the time of its last packet. The files of nuScenes hold the
rays in the order in which they were fired: all 32 beams of a firing, 46.08 microseconds (HDL-32E, user's manual) before
those of the next; rays without a return have the range 0. Files of returns alone, in any order, are read as well: their
returns have no times.

Sources: https://forum.nuscenes.org/t/245 (start on the left, clockwise, compensated packet by packet), .../t/821
(compensated); the order was found in a file of the dataset.
"""

from pathlib import Path

import numpy as np

from drivesplat.scene.sensors import LidarReturns

_COLUMNS = 5
_MAX_RING = 1e6
BEAMS = 32
FIRING_S = 46.08e-6
"""Seconds between the firings of a beam."""


def read_file(path: Path) -> LidarReturns | str:
    """The returns with finite coordinates of an existing file, or its fault."""
    size = path.stat().st_size
    if size == 0 or size % (4 * _COLUMNS):
        return f"is corrupt ({size} bytes are no whole number of returns)"
    returns = np.fromfile(path, dtype=np.float32).reshape(-1, _COLUMNS)
    finite = np.isfinite(returns[:, :3]).all(axis=1)
    with np.errstate(invalid="ignore", over="ignore"):  # random bytes; `sweeps.read_returns` refuses them
        rings = np.nan_to_num(returns[:, 4], nan=-1.0).clip(-1.0, _MAX_RING).astype(np.int64)
        firings, rest = divmod(len(rings), BEAMS)
        offsets_s, returns = None, returns[finite]
        if not rest and firings >= 2 and (rings.reshape(firings, BEAMS) == np.arange(BEAMS)).all():
            offsets_s = np.repeat(FIRING_S * np.arange(1 - firings, 1, dtype=np.float64), BEAMS)[finite]
        return LidarReturns(returns[:, :3].astype(np.float64), returns[:, 3] / 255.0, rings[finite], offsets_s)
