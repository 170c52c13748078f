"""The records of a segment as v1 and v2 hold them, before any check of their values.

Numbers of sensors are those of `names`. Transforms are lists of 16 numbers, row-major; times of images are seconds.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.record_names import named, shown
from drivesplat.readers.waymo.names import CAMERAS, LASERS

MAX_CELLS = 5_000_000
"""Maximum number of values of a range image: that of the largest laser has 64 x 2650 pixels with 6 values."""


@dataclass(frozen=True)
class CameraRecord:
    """Calibration of a camera. `intrinsic`: f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3; `extrinsic`: camera to vehicle."""

    number: int
    intrinsic: list[Any]
    extrinsic: Any
    width: Any
    height: Any
    direction: int


@dataclass(frozen=True)
class LaserRecord:
    """Calibration of a laser. `inclinations` of its rows, lowest first, empty where they are uniform between `lowest`
    and `highest` (radians); `extrinsic`: laser to vehicle."""

    number: int
    inclinations: list[Any]
    lowest: Any
    highest: Any
    extrinsic: Any


@dataclass(frozen=True)
class ImageRecord:
    """An image of the frame at `frame` (microseconds). `pose`: vehicle to world at `pose_timestamp`; `shutter`,
    `trigger` and `readout_done` in seconds."""

    frame: int
    camera: int
    pose: Any
    pose_timestamp: Any
    shutter: Any
    trigger: Any
    readout_done: Any


@dataclass(frozen=True)
class BoxRecord:
    """A box of the frame at `frame`, in the vehicle's frame at the frame's pose: `size` is length, width, height."""

    frame: int
    id: Any
    type: int
    center: list[Any]
    size: list[Any]
    heading: Any


@dataclass
class Segment:
    """A segment without images and range images. `frames`: vehicle to world by timestamp; `sweeps`: the timestamp and
    the laser of each range image; `shapes`: rows and columns of a laser's first range image."""

    name: str
    version: str
    frames: dict[int, Any] = field(default_factory=dict)
    cameras: dict[int, CameraRecord] = field(default_factory=dict)
    lasers: dict[int, LaserRecord] = field(default_factory=dict)
    images: list[ImageRecord] = field(default_factory=list)
    boxes: list[BoxRecord] = field(default_factory=list)
    sweeps: list[tuple[int, int]] = field(default_factory=list)
    shapes: dict[int, tuple[int, int]] = field(default_factory=dict)

    def camera(self, number: int) -> CameraRecord:
        """The calibration of a camera. Raises DatasetError where there is none."""
        if number not in self.cameras:
            raise DatasetError(f"{camera_name(number)}: segment {self.name} has no calibration of it")
        return self.cameras[number]

    def laser(self, number: int) -> LaserRecord:
        """The calibration of a laser. Raises DatasetError where there is none."""
        if number not in self.lasers:
            raise DatasetError(f"{laser_name(number)}: segment {self.name} has range images of it, but no calibration")
        return self.lasers[number]


@dataclass(frozen=True)
class ChosenRecordings:
    """Which recordings to read: frame timestamps with numbers of cameras, or of lasers."""

    images: frozenset[tuple[int, int]]
    sweeps: frozenset[tuple[int, int]]


@dataclass(frozen=True)
class ImageFile:
    """The JPEG file of an image, unchanged; empty where there is none."""

    frame: int
    camera: int
    content: bytes


@dataclass(frozen=True)
class PanopticLabel:
    """The panoptic label of an image: a PNG file of 16 bits, whose values are class * `divisor` + instance."""

    frame: int
    camera: int
    content: bytes
    divisor: int


@dataclass(frozen=True)
class RangeImage:
    """The first returns of a laser in the frame at `frame`, whose pose is `frame_pose`. `values` (rows, columns, 4)
    float32: range in metres, intensity, elongation, no-label zone; `poses` (rows, columns, 6) float32: roll, pitch,
    yaw, x, y, z of the vehicle in the world at each pixel, for the laser that has them."""

    frame: int
    laser: LaserRecord
    frame_pose: Any
    values: np.ndarray
    poses: np.ndarray | None


def camera_name(number: int) -> str:
    """The name of a camera, for messages."""
    return named("camera", CAMERAS.get(number, str(number)))


def laser_name(number: int) -> str:
    """The name of a laser, for messages."""
    return named("laser", LASERS.get(number, str(number)))


def sweep_name(laser: int, frame: int) -> str:
    """The name of a range image, for messages."""
    return named("sweep", f"{LASERS.get(laser, laser)}/{frame}")


def frame_name(time: Any) -> str:
    """The name of a frame, for messages."""
    return named("frame", str(time))


def cells(values: np.ndarray, shape: Iterable[Any], channels: int, record: str) -> np.ndarray:
    """The flat values of a range image as (rows, columns, channels) float32. Raises DatasetError naming `record` where
    their number is another one."""
    size = list(shape)
    fits = len(size) == 3 and all(isinstance(length, int) and 0 < length <= MAX_CELLS for length in size)
    fits = fits and size[2] == channels and size[0] * size[1] <= MAX_CELLS
    if not fits or len(values) != size[0] * size[1] * size[2]:
        raise DatasetError(
            f"{record}: its range image has {len(values)} values and the shape {shown(size)}; it must have rows, "
            f"columns and {channels} values each"
        )
    return np.asarray(values, dtype=np.float32).reshape(size)
