"""Reading LiDAR sweeps of any dataset."""

from pathlib import Path
from types import ModuleType

from drivesplat.errors import DatasetError
from drivesplat.readers.by_name import dataset_module
from drivesplat.readers.drive_checks import returns_fault
from drivesplat.readers.sweep_motion import compensated, motion_fault
from drivesplat.scene.scan import Scan
from drivesplat.scene.scene import Sweep, place_of
from drivesplat.scene.sensors import LidarReturns, Spin

SWEEP_FILE = "drivesplat.readers.*.sweep_file"
"""The module of a reader with `read_file`."""


def read_returns(sweep: Sweep) -> LidarReturns:
    """The returns of a sweep that have finite coordinates, motion-compensated.

    Raises DatasetError naming the sweep's token and path if the file is missing, truncated or empty, or its returns are
    none of a LiDAR on a vehicle.
    """
    returns = _returns(sweep)
    if isinstance(returns, str):
        leave_out = "" if sweep.is_key_frame else "lidar_seed.sweeps: false to do without all between key frames, or "
        raise DatasetError(
            f"{_named(sweep, returns)}; restore it, or set {leave_out}lidar_seed.on_missing: warn to go on without it"
        )
    return returns


def read_scan(sweep: Sweep, spin: Spin | None) -> Scan | None:
    """All rays of a sweep, where its file holds them; None if it holds returns alone. `spin` gives the times of rays.
    Raises DatasetError naming the sweep's token and path if the file is missing or damaged."""
    read = getattr(_files(sweep), "read_scan", None)
    if read is None:
        return None
    read_returns(sweep)
    try:
        return read(Path(sweep.path), spin)
    except (OSError, KeyError, ValueError, IndexError) as error:
        raise DatasetError(_named(sweep, f"is corrupt ({' '.join(str(error).split())[:200]})")) from error


def sweep_fault(sweep: Sweep) -> str | None:
    """The fault of a sweep's file, with its token and path; None if there is none."""
    returns = _returns(sweep, compensate=False)
    return _named(sweep, returns) if isinstance(returns, str) else None


def sound_returns(sweep: Sweep) -> LidarReturns | None:
    """The returns of a sweep, as `read_returns` gives them; None where its file has a fault."""
    returns = _returns(sweep)
    return None if isinstance(returns, str) else returns


def _returns(sweep: Sweep, compensate: bool = True) -> LidarReturns | str:
    """The returns of a sweep, or the fault of its file."""
    path = Path(sweep.path)
    if not path.is_file():
        return "is missing"
    returns = _files(sweep).read_file(path)
    if isinstance(returns, str):
        return returns
    if fault := returns_fault(returns):
        return fault
    if sweep.motion is None:
        return returns
    fault = motion_fault(returns, sweep.motion)
    return fault or (compensated(returns, sweep.motion) if compensate else returns)


def _named(sweep: Sweep, fault: str) -> str:
    return f"{place_of(sweep)}: LiDAR file {sweep.path} {fault}"


def _files(sweep: Sweep) -> ModuleType:
    return dataset_module(SWEEP_FILE, sweep.reader)
