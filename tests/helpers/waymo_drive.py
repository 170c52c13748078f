"""The tiny drive as Waymo records it, before it is written as v1 or v2 (`waymo_files`).

Written from the documented format, not from the reader: camera axes x forward, y left, z up; range images with row 0 at
the top and columns that run clockwise from straight behind; a TOP laser with 64 explicit inclinations whose pixels have
poses of their own, and others with a least and a greatest inclination. Everything lies far from zero and turned, as
Waymo's world does.
"""

from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene
from helpers.drives import CAMERA_AT, LIDAR_AT, World, cast, scene_at, seconds_of

NAME = "1234567890123456789_100_000_120_000"
TYPES = {
    ObjectClass.CAR: 1, ObjectClass.TRUCK: 1, ObjectClass.PEDESTRIAN: 2, ObjectClass.OTHER_MOVABLE: 3,
    ObjectClass.RIDER: 4,
}  # fmt: skip
REACH = 70.0
COLUMNS, BLOCK = 120, 6
"""Columns of the TOP laser, and how many of them share a time."""
SWEEP_S = 0.1
READOUT_S, SHUTTER_S = 0.04, 0.004


GLOBAL = rigid(Rotation.from_euler("z", 0.7).as_matrix(), np.array([-25_211.25, 42_391.125, -160.5]))
"""The scene's world in that of the segment."""


@dataclass
class CameraRecording:
    number: int
    extrinsic: np.ndarray
    intrinsic: list[float]
    width: int
    height: int
    direction: int = 2


@dataclass
class LaserRecording:
    number: int
    extrinsic: np.ndarray
    rows: int
    columns: int
    inclinations: np.ndarray | None
    lowest: float
    highest: float

    def elevations(self) -> np.ndarray:
        """Of the rows from the top: explicit ones, or the middles of equal steps."""
        if self.inclinations is not None:
            return np.array(sorted(self.inclinations, reverse=True))
        step = (self.highest - self.lowest) / self.rows
        return np.array([self.highest - step * (row + 0.5) for row in range(self.rows)])

    def headings(self) -> np.ndarray:
        """Of the columns, in the vehicle's frame: clockwise, from behind to behind."""
        return np.array([np.pi - 2 * np.pi * (column + 0.5) / self.columns for column in range(self.columns)])


@dataclass
class ImageRecording:
    frame: int
    camera: int
    pose: np.ndarray
    seconds: float
    content: bytes


@dataclass
class LabelRecording:
    """A panoptic label: a PNG file of 16 bits with `divisor` times the class plus an instance."""

    frame: int
    camera: int
    content: bytes
    divisor: int


@dataclass
class RangeRecording:
    """`hits` (rows, columns, 3): where each ray ends in the segment's world, NaN without a return."""

    frame: int
    laser: int
    values: np.ndarray
    poses: np.ndarray | None
    hits: np.ndarray


@dataclass
class BoxRecording:
    frame: int
    id: str
    type: int
    center: np.ndarray
    size: np.ndarray
    heading: float


@dataclass
class Drive:
    name: str
    frames: dict[int, np.ndarray]
    cameras: list[CameraRecording]
    lasers: list[LaserRecording]
    images: list[ImageRecording]
    sweeps: list[RangeRecording]
    boxes: list[BoxRecording] = field(default_factory=list)
    labels: list[LabelRecording] = field(default_factory=list)


def tiny_drive(
    root: Path, world: World | None = None, lasers: tuple[int, ...] = (1, 2, 5), scan: LaserRecording | None = None,
    place: np.ndarray = GLOBAL,
) -> tuple[Drive, Scene]:  # fmt: skip
    """The tiny drive in `root` as Waymo records it, and the scene that nuScenes' tables give. With `scan`, that is its
    only laser. `place` (4, 4): the scene's world in that of the segment."""
    scene, world = scene_at(root, sweeps=False), world or World()
    poses = {time: place @ rigid(np.eye(3), world.ego_at(seconds_of(time))) for time in scene.key_frame_timestamps}
    recorded = [scan] if scan else [laser for laser in _lasers() if laser.number in lasers]
    sweeps = [_sweep(world, laser, int(time), place) for time in poses for laser in recorded]
    frames, boxes = {int(time): pose for time, pose in poses.items()}, _boxes(scene, poses, place)
    return Drive(NAME, frames, _cameras(scene), recorded, _images(scene, place), sweeps, boxes), scene


def tables_scan() -> LaserRecording:
    """The beams and steps of the LiDAR in nuScenes' tables, all at one time: a laser without poses of pixels."""
    inclinations = np.radians(np.linspace(-28, 10, 24))
    return LaserRecording(2, rigid(np.eye(3), LIDAR_AT), 24, 240, inclinations, inclinations[0], inclinations[-1])


def _lasers() -> list[LaserRecording]:
    """A TOP laser that is mounted backwards and tilted, and four around the vehicle that look down, too."""
    inclinations = np.concatenate([np.linspace(-0.306, -0.05, 34), np.linspace(-0.046, 0.0437, 30)])
    top = rigid(Rotation.from_euler("zyx", [-2.58, 0.004, -0.006]).as_matrix(), LIDAR_AT)
    found = [LaserRecording(1, top, 64, COLUMNS, inclinations, -0.31, 0.045)]
    around = [(0.0, 4.0, 0.0), (1.57, 3.2, 1.0), (-1.6, 3.2, -1.0), (3.1, -1.1, 0)]
    for number, (turn, x, y) in enumerate(around, start=2):
        mount = rigid(Rotation.from_euler("zyx", [turn, 0.02, -0.01]).as_matrix(), np.array([x, y, 0.7]))
        found.append(LaserRecording(number, mount, 20, 60, None, -np.pi / 2, np.pi / 6))
    return found


def _cameras(scene: Scene) -> list[CameraRecording]:
    """The scene's camera as FRONT, and SIDE_LEFT with smaller images."""
    k, (width, height) = scene.cameras[0].intrinsics, (scene.cameras[0].width, scene.cameras[0].height)
    intrinsic = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    left = rigid(Rotation.from_euler("z", np.pi / 2).as_matrix(), np.array([1.4, 0.1, 1.5]))
    return [
        CameraRecording(1, rigid(np.eye(3), CAMERA_AT), intrinsic, width, height),
        CameraRecording(4, left, intrinsic, width, height - 16, direction=1),
    ]


def _images(scene: Scene, place: np.ndarray) -> list[ImageRecording]:
    found = []
    for frame in scene.frames:
        pose, seconds = place @ frame.ego_to_world, frame.timestamp * 1e-6
        time = int(scene.key_frame_timestamps[frame.sample_index])
        found.append(ImageRecording(time, 1, pose, seconds, Path(frame.image_path).read_bytes()))
        plain = BytesIO()
        Image.new("RGB", (frame.width, frame.height - 16), (20 * frame.sample_index, 90, 120)).save(plain, "JPEG")
        found.append(ImageRecording(time, 4, pose, seconds + 0.01, plain.getvalue()))
    return found


def _sweep(world: World, laser: LaserRecording, time: int, place: np.ndarray) -> RangeRecording:
    """A revolution around the time of a frame; lasers without poses of pixels measure at that time."""
    rows, columns = laser.rows, laser.columns
    values, poses = np.full((rows, columns, 4), -1.0), np.zeros((rows, columns, 6))
    hits = np.full((rows, columns, 3), np.nan)
    block = BLOCK if laser.number == 1 else columns
    yaw = np.arctan2(laser.extrinsic[1, 0], laser.extrinsic[0, 0])
    up, around = np.meshgrid(laser.elevations(), laser.headings() - yaw, indexing="ij")
    rays = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1)
    for first in range(0, columns, block):
        part = slice(first, first + block)
        seconds = seconds_of(time) + (SWEEP_S * (first / columns - 0.5) if laser.number == 1 else 0.0)
        vehicle = rigid(np.eye(3), world.ego_at(seconds))
        sensor = vehicle @ laser.extrinsic
        turned = rays[:, part].reshape(-1, 3) @ sensor[:3, :3].T
        distance, _ = cast(world, sensor[:3, 3], turned, seconds)
        hit = distance < REACH
        ends = np.where(hit[:, None], sensor[:3, 3] + turned * distance[:, None], np.nan)
        hits[:, part] = (ends @ place[:3, :3].T + place[:3, 3]).reshape(rows, -1, 3)
        values[:, part, 0] = np.where(hit, distance, -1.0).reshape(rows, -1)
        values[:, part, 1] = np.where(hit, 0.25, -1.0).reshape(rows, -1)
        values[:, part, 2] = np.where(hit, 0.0, -1.0).reshape(rows, -1)
        pose = place @ vehicle
        yaw_pitch_roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
        poses[:, part] = [*yaw_pitch_roll[::-1], *pose[:3, 3]]
    return RangeRecording(time, laser.number, values, poses if laser.number == 1 else None, hits)


def _boxes(scene: Scene, poses: dict[int, np.ndarray], place: np.ndarray) -> list[BoxRecording]:
    """Boxes in the vehicle's frame of each frame. The vehicle drives straight on: a heading is a whole rotation."""
    found = []
    for track in scene.tracks:
        for time, pose in zip(track.timestamps, track.object_to_world, strict=True):
            in_vehicle = np.linalg.inv(poses[time]) @ place @ pose
            heading = float(np.arctan2(in_vehicle[1, 0], in_vehicle[0, 0]))
            kind = TYPES[track.object_class]
            found.append(BoxRecording(int(time), track.id, kind, in_vehicle[:3, 3], track.size, heading))
    return found


def panoptic(frame: int, camera: int, classes: np.ndarray) -> LabelRecording:
    """The panoptic label of an image with these classes, all of instance 7."""
    png = BytesIO()
    Image.fromarray((classes.astype(np.uint16) * 1000 + 7).astype(np.uint16)).save(png, "PNG")
    return LabelRecording(frame, camera, png.getvalue(), 1000)
