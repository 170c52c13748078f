"""The LiDAR returns nearest in time to an image."""

from collections.abc import Iterable
from contextlib import suppress

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.lidar.sweeps import without_ego_vehicle
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.rigid import apply
from drivesplat.scene.scene import Sweep


def nearest_returns(
    sweeps: Iterable[Sweep], timestamp: int, interval: float, own_car_radius: float = 0.0
) -> np.ndarray | None:
    """World points (n, 3) of the readable sweep nearest to `timestamp`, without those within `own_car_radius` metres of
    the sensor; None if no sweep is within `interval`. Times are in microseconds."""
    for sweep in sorted(sweeps, key=lambda sweep: abs(sweep.timestamp - timestamp)):
        if abs(sweep.timestamp - timestamp) >= interval:
            break
        with suppress(DatasetError):  # the stage lidar_seed reports unreadable files
            return apply(sweep.sensor_to_world, without_ego_vehicle(read_returns(sweep).points, own_car_radius))
    return None
