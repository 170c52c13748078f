"""Waymo's cameras and lasers as those of a scene, with every value checked.

Waymo's camera axes are x forward, y left, z up, and its pixels count from the corner of the image (dataset.proto: pixel
0 is the left edge of the first pixel); a scene has OpenCV's axes, and integer coordinates at pixel centres.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import (
    MAX_COORDINATE,
    MAX_MOUNT,
    MAX_READOUT_S,
    checked_beams,
    checked_intrinsics,
    checked_numbers,
    checked_readout,
    checked_size,
    checked_transform,
    is_number,
)
from drivesplat.readers.waymo.names import CAMERAS, GLOBAL_SHUTTER, LASERS, READOUT_DIRECTIONS
from drivesplat.readers.waymo.range_image import column_azimuth, elevations
from drivesplat.readers.waymo.segment import CameraRecord, ImageRecord, LaserRecord, camera_name, laser_name
from drivesplat.scene.rigid import rigid
from drivesplat.scene.sensors import Camera, Lidar, Spin

FROM_OPENCV = rigid(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""OpenCV's camera axes (x right, y down, z forward) to Waymo's."""
MAX_INTRINSIC = 1e6
HALF_PIXEL = 0.5
REVOLUTION_S = 0.1
"""Seconds of a revolution: frames come at 10 Hz, and each holds one."""
SINGLE = 1e-6
"""Deviation of an angle that is the rounding of single precision."""


def pose_of(values: Any, record: str, bound: float = MAX_COORDINATE) -> np.ndarray:
    """The transform (4, 4) of 16 numbers, row-major, with a translation of at most `bound` metres. Raises DatasetError
    naming `record` if it is not rigid."""
    is_row = isinstance(values, list | tuple | np.ndarray) and len(values) == 16
    matrix = np.array(values, dtype=object).reshape(4, 4).tolist() if is_row else values
    return checked_transform(matrix, record, bound)


def camera_mount(camera: CameraRecord) -> np.ndarray:
    """Camera, with OpenCV's axes, to vehicle (4, 4)."""
    return pose_of(camera.extrinsic, camera_name(camera.number), MAX_MOUNT) @ FROM_OPENCV


def laser_mount(laser: LaserRecord) -> np.ndarray:
    """Laser to vehicle (4, 4)."""
    return pose_of(laser.extrinsic, laser_name(laser.number), MAX_MOUNT)


def camera_of(camera: CameraRecord, images: Iterable[ImageRecord]) -> Camera:
    """A camera, with the median readout time of its `images`: time from the trigger to the end of the readout, less the
    exposure of a line."""
    record = camera_name(camera.number)
    width, height = checked_size(camera.width, camera.height, record)
    f_u, f_v, c_u, c_v, *distortion = checked_numbers(
        camera.intrinsic, 9, MAX_INTRINSIC, record, "intrinsic", "f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3"
    )
    k = [[f_u, 0.0, c_u - HALF_PIXEL], [0.0, f_v, c_v - HALF_PIXEL], [0.0, 0.0, 1.0]]
    times = [
        image.readout_done - image.trigger - image.shutter
        for image in images
        if all(map(is_number, (image.trigger, image.shutter, image.readout_done))) and image.trigger > 0
    ]
    readout = float(np.median(times)) if times else None
    if camera.direction == GLOBAL_SHUTTER:
        readout = 0.0
    seconds, direction = checked_readout(readout, READOUT_DIRECTIONS.get(camera.direction), record)
    return Camera(
        CAMERAS[camera.number], width, height, checked_intrinsics(k, record, (width, height)), np.array(distortion),
        seconds, direction, "opencv" if np.any(distortion) else "none",
    )  # fmt: skip


def readout_middle(image: ImageRecord) -> float:
    """Seconds from the time of an image's pose to the middle between its trigger and the end of its readout; 0 where
    these are unknown, or too far from the pose to be times of one clock."""
    times = image.pose_timestamp, image.trigger, image.readout_done
    if not all(map(is_number, times)) or image.trigger <= 0:
        return 0.0
    middle = 0.5 * (image.trigger + image.readout_done) - image.pose_timestamp
    return float(middle) if abs(middle) <= MAX_READOUT_S else 0.0


def lidar_of(laser: LaserRecord, shape: tuple[int, int] | None) -> Lidar:
    """A laser whose range images have a `shape` (rows, columns), with the elevation of each row, the highest first.

    Times of returns are not published. TOP, whose pixels have poses, is taken to look ahead at the frame's pose.
    """
    rows, columns = shape or (len(laser.inclinations), None)
    beams, spin = checked_beams(laser_elevations(laser, rows), columns, laser_name(laser.number)), None
    if LASERS[laser.number] == "TOP":
        spin = Spin(REVOLUTION_S, -0.5 * REVOLUTION_S, column_azimuth(0.0, laser_mount(laser)))
    return Lidar(LASERS[laser.number], *beams, spin)


def laser_elevations(laser: LaserRecord, rows: int) -> np.ndarray:
    """The elevation (rows,) of each row of a laser's range images, the highest first."""
    record = laser_name(laser.number)
    explicit, _ = checked_beams(laser.inclinations or None, None, record)
    if explicit is not None:
        return elevations(explicit, 0.0, 0.0, rows, record)
    ends = checked_numbers(
        [laser.lowest, laser.highest], 2, np.pi / 2 + SINGLE, record, "range of beam inclinations", "radians"
    )
    lowest, highest = ends.clip(-np.pi / 2, np.pi / 2)
    if not lowest < highest:
        raise DatasetError(f"{record}: its least beam inclination {lowest:g} is not below the greatest, {highest:g}")
    return elevations(np.zeros(0), lowest, highest, rows, record)
