"""Range images as rays and points.

Row 0 is the highest beam, so that inclinations, which calibrations give lowest first, are reversed. Column j of W looks
at the azimuth pi (2 (W - j - 1/2) / W - 1) - atan2(E10, E00), with the laser's extrinsic E (to the vehicle): column W/2
looks ahead, the scan runs clockwise. Where pixels have poses, a point is carried by its own vehicle pose into the world
and back by that of the frame. After `compute_range_image_polar`, `compute_inclination` and
`compute_range_image_cartesian` in waymo_open_dataset/utils/range_image_utils.py, and `get_rotation_matrix` in
transform_utils.py, of github.com/waymo-research/waymo-open-dataset.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.scene.rigid import apply, inverse


@dataclass(frozen=True)
class LaserRays:
    """All n rays of a sweep, with and without a return, in the laser's frame at the time of each: `azimuth` and
    `elevation` in radians, `range` in metres (NaN without a return), `row`, an index of `Lidar.beam_elevations`."""

    azimuth: np.ndarray
    elevation: np.ndarray
    range: np.ndarray
    row: np.ndarray


def elevations(inclinations: np.ndarray, lowest: float, highest: float, rows: int, record: str) -> np.ndarray:
    """The elevation (rows,) of each row of a range image, row 0 first: `inclinations` (lowest first) where there are
    any, otherwise the middles of equal parts from `lowest` to `highest`. Raises DatasetError naming `record` where
    inclinations and rows differ in number."""
    if not len(inclinations):
        return (lowest + (np.arange(rows) + 0.5) / rows * (highest - lowest))[::-1]
    if len(inclinations) != rows:
        raise DatasetError(
            f"{record}: its range image has {rows} rows, and its laser {len(inclinations)} beam inclinations; both "
            "must be of one segment"
        )
    return inclinations[::-1]


def column_azimuth(fraction: Any, extrinsic: np.ndarray) -> Any:
    """The azimuth in the laser's frame after a fraction of the columns, an array or one."""
    return np.pi * (1.0 - 2.0 * fraction) - np.arctan2(extrinsic[1, 0], extrinsic[0, 0])


def points_of(
    rays: LaserRays, extrinsic: np.ndarray, pixel_poses: np.ndarray | None = None, frame_pose: np.ndarray | None = None
) -> np.ndarray:
    """The returns (m, 3) of rays that have one, in order, in the laser's frame at the frame's pose. `extrinsic` (4, 4):
    laser to vehicle; `pixel_poses` (n, 6): roll, pitch, yaw, x, y, z of the vehicle at each ray, `frame_pose` (4, 4)
    that of the frame."""
    hit = np.isfinite(rays.range)
    azimuth, elevation, level = rays.azimuth[hit], rays.elevation[hit], np.cos(rays.elevation[hit])
    ways = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    points = ways * rays.range[hit, None]
    if pixel_poses is None or frame_pose is None:
        return points
    with np.errstate(invalid="ignore", over="ignore"):  # damaged poses; `sweep_file` leaves their points out
        in_world = _moved(apply(extrinsic, points), pixel_poses[hit].astype(np.float64), frame_pose[:3, 3])
        return apply(inverse(extrinsic), in_world @ frame_pose[:3, :3])


def _moved(points: np.ndarray, poses: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Points (m, 3) of the vehicle's frame by a pose (m, 6) each, in world coordinates from `origin` (3,). Rotations
    are yaw, pitch, roll about z, y, x."""
    x, y, z = points.T
    (sin_r, sin_p, sin_y), (cos_r, cos_p, cos_y) = np.sin(poses[:, :3]).T, np.cos(poses[:, :3]).T
    y, z = cos_r * y - sin_r * z, sin_r * y + cos_r * z
    x, z = cos_p * x + sin_p * z, cos_p * z - sin_p * x
    x, y = cos_y * x - sin_y * y, sin_y * x + cos_y * y
    return np.stack([x, y, z], axis=1) + (poses[:, 3:] - origin)
