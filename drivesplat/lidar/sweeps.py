"""LiDAR sweeps in world coordinates, without returns of the ego vehicle or of boxes."""

from collections.abc import Iterable
from contextlib import suppress

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.rigid import apply
from drivesplat.scene.scene import Scene, Sweep
from drivesplat.scene.splits import Group, sweep_groups
from drivesplat.scene.tracks import Box
from drivesplat.settings.images import HoldoutSettings


def sweeps_of(scene: Scene, holdout: HoldoutSettings, groups: tuple[Group, ...] = ("train",)) -> list[Sweep]:
    """The sweeps of the given groups, at and between key frames."""
    owners = sweep_groups(scene, holdout)
    return [sweep for sweep, group in zip(scene.sweeps, owners, strict=True) if group in groups]


def returns_of(
    scene: Scene, holdout: HoldoutSettings, own_car_radius: float, groups: tuple[Group, ...] = ("train",)
) -> list[tuple[Sweep, np.ndarray]]:
    """The sweeps of the given groups, each with its `world_returns`. Sweeps with a missing or corrupt file are left
    out; the stage lidar_seed reports them."""
    found = []
    for sweep in sweeps_of(scene, holdout, groups):
        with suppress(DatasetError):
            found.append((sweep, world_returns(sweep, own_car_radius)))
    return found


def nearest_returns(
    sweeps: Iterable[Sweep], timestamp: int, interval: float, own_car_radius: float = 0.0
) -> np.ndarray | None:
    """The `world_returns` of the readable sweep nearest to `timestamp`; None if no sweep is within `interval`. Times
    are in microseconds."""
    for sweep in sorted(sweeps, key=lambda sweep: abs(sweep.timestamp - timestamp)):
        if abs(sweep.timestamp - timestamp) >= interval:
            break
        with suppress(DatasetError):  # the stage lidar_seed reports unreadable files
            return world_returns(sweep, own_car_radius)
    return None


def world_returns(sweep: Sweep, own_car_radius: float) -> np.ndarray:
    """The returns (n, 3) of a sweep in world coordinates, without those of the ego vehicle, which are within
    `own_car_radius` metres of the sensor. Raises DatasetError if its file is missing or corrupt."""
    return apply(sweep.sensor_to_world, without_ego_vehicle(read_returns(sweep).points, own_car_radius))


def without_ego_vehicle(points: np.ndarray, radius: float) -> np.ndarray:
    """Sensor-frame returns (n, 3) farther than `radius` metres (horizontally) from the sensor."""
    return points[np.hypot(points[:, 0], points[:, 1]) > radius]


def outside_boxes(points: np.ndarray, boxes: list[Box], margin: float) -> np.ndarray:
    """Whether world points (n, 3) lie outside all boxes, expanded by `margin` metres on every side: (n,) bool."""
    outside = np.ones(len(points), dtype=bool)
    for box in boxes:
        outside &= ~box.contains(points, margin, floor=-margin)
    return outside


def thin(points: np.ndarray, voxel: float) -> np.ndarray:
    """Ascending indices (m,) of one point per occupied voxel of edge `voxel` metres; all indices for voxel 0."""
    if voxel == 0 or len(points) == 0:
        return np.arange(len(points))
    cells = np.floor(points / voxel).astype(np.int64)
    cells -= cells.min(axis=0)
    spans = cells.max(axis=0) + 1
    keys = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    return np.sort(np.unique(keys, return_index=True)[1])
