"""Reading LiDAR sweeps of any dataset."""

from pathlib import Path
from types import ModuleType

from drivesplat.errors import DatasetError
from drivesplat.readers.by_name import dataset_module
from drivesplat.scene.scene import Sweep, place_of
from drivesplat.scene.sensors import LidarReturns

SWEEP_FILE = "drivesplat.readers.*.sweep_file"
"""The module of a reader with `read_file` and `file_fault`."""


def read_returns(sweep: Sweep) -> LidarReturns:
    """The returns of a sweep that have finite coordinates.

    Raises DatasetError naming the sweep's token and path if the file is missing, truncated or empty.
    """
    fault = sweep_fault(sweep)
    if fault:
        leave_out = "" if sweep.is_key_frame else "lidar_seed.sweeps: false to do without all between key frames, or "
        raise DatasetError(f"{fault}; restore it, or set {leave_out}lidar_seed.on_missing: warn to go on without it")
    return _files(sweep).read_file(Path(sweep.path))


def sweep_fault(sweep: Sweep) -> str | None:
    """The fault of a sweep's file, with its token and path; None if there is none."""
    path = Path(sweep.path)
    fault = _files(sweep).file_fault(path) if path.is_file() else "is missing"
    return f"{place_of(sweep)}: LiDAR file {path} {fault}" if fault else None


def _files(sweep: Sweep) -> ModuleType:
    return dataset_module(SWEEP_FILE, sweep.reader)
