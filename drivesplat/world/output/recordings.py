"""Images, LiDAR sweeps and class maps of a world as files, and the boxes of its key frames."""

import shutil
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from drivesplat.errors import ResultError
from drivesplat.io.storage import atomic_write
from drivesplat.readers.nuscenes.tokens import token
from drivesplat.scene.images import write_png
from drivesplat.settings.world import WorldSettings
from drivesplat.world.optics.rig import RigSensor, image_height, key_frame_time, recording_sensors, trigger_times
from drivesplat.world.recorder import Recorder
from drivesplat.world.shapes.mesh import SurfaceClass

START_US = 1_767_225_600_000_000
ANNOTATED_RANGE = 80.0
"""Objects farther from the ego vehicle than this (metres) have no box."""
JPEG_QUALITY = 95
SEMANTIC, SKY = "semantic", "sky"
"""Folders below the dataset's root."""
UNLABELLED = 255
JPEG_BYTES, TRUTH_BYTES, CLASS_BYTES = 0.45, 2.6, 0.06
"""Bytes per pixel: of an image, of all images of a true view, of the class and sky maps of an image."""
SWEEP_BYTES, SCAN_BYTES = 600_000, 250_000
"""Bytes of a sweep of 32 beams, and of its truth."""


@dataclass(frozen=True)
class SensorFile:
    """An image or sweep to write. `path` is relative to the dataset's root; `time_us` counts from the drive's start."""

    sensor: RigSensor
    time_us: int
    is_key_frame: bool
    index: int
    token: str
    path: str

    @classmethod
    def of(cls, scene: str, sensor: RigSensor, time_us: int, is_key_frame: bool, index: int) -> "SensorFile":
        """A recording of the drive `scene` that belongs to key frame `index`."""
        folder, suffix = "samples" if is_key_frame else "sweeps", "jpg" if sensor.is_camera else "pcd.bin"
        path = f"{folder}/{sensor.channel}/{scene}__{sensor.channel}__{START_US + time_us}.{suffix}"
        return cls(sensor, time_us, is_key_frame, index, token(scene, sensor.channel, time_us), path)


@dataclass(frozen=True)
class KeyFrameBox:
    """The box of an object at key frame `index`: `pose` (4, 4) of its centre in the tables' frame, `size` (3,): length,
    width, height in metres; the fraction of it that cameras see, and the number of LiDAR returns from it."""

    index: int
    name: str
    category: str
    attribute: str | None
    pose: np.ndarray
    size: np.ndarray
    visible: float
    lidar_points: int


def sensor_files(world: WorldSettings, scene: str) -> list[SensorFile]:
    """All recordings of the drive `scene`, by sensor and time."""
    sensors = recording_sensors(world)
    return [SensorFile.of(scene, sensor, *row) for sensor in sensors for row in trigger_times(sensor, world)]


def write_recording(root: Path, recorder: Recorder, file: SensorFile) -> np.ndarray | None:
    """Writes an image or a sweep. Returns the number of LiDAR returns per object, None for images."""
    with atomic_write(root / file.path) as target:
        if not file.sensor.is_camera:
            scan = recorder.scan(file.sensor, file.time_us)
            target.write(recorder.returns(scan, file.sensor, file.time_us).tobytes())
            return np.bincount(scan.object[scan.returned], minlength=len(recorder.objects))
        picture = recorder.picture(file.sensor, file.time_us)
        image = recorder.to_bytes(picture.radiance, file.sensor, file.time_us)
        Image.fromarray(image).save(target, "JPEG", quality=JPEG_QUALITY)
    if recorder.world.class_maps:
        # the sky is unlabelled in the class map: it has no Gaussians
        sky, name = picture.classes == SurfaceClass.SKY, f"{file.sensor.channel}/{PurePosixPath(file.path).stem}.png"
        write_png(root / SKY / name, np.where(sky, 255, 0).astype(np.uint8))
        write_png(root / SEMANTIC / name, np.where(sky, UNLABELLED, picture.classes).astype(np.uint8))
    return None


def boxes(recorder: Recorder, index: int, visible: np.ndarray, lidar_points: np.ndarray) -> list[KeyFrameBox]:
    """The boxes of key frame `index`: objects in range that a camera (`visible` (objects,), fractions) or the LiDAR
    (`lidar_points` (objects,), numbers) sees."""
    seconds, found = key_frame_time(recorder.world, index) * 1e-6, []
    ego = recorder.street_to_global @ recorder.ego_pose(seconds)
    for item, fraction, points in zip(recorder.objects, visible.tolist(), lidar_points.tolist(), strict=True):
        if item.category is None or not (fraction or points):
            continue
        box = recorder.box_to_global(item, seconds)
        if np.linalg.norm((box - ego)[:2, 3]) <= ANNOTATED_RANGE:
            found.append(KeyFrameBox(index, item.name, item.category, item.attribute, box, item.size, fraction, points))
    return found


def world_bytes(world: WorldSettings, images: int, sweeps: int, views: int, scans: int) -> int:
    """The approximate size in bytes of a world of so many images and sweeps, and of true views and scans, which are
    written for each key frame."""
    pixels, rays = world.width * image_height(world.width), world.lidar.beams / 32
    per_image = JPEG_BYTES + (CLASS_BYTES if world.class_maps else 0.0)
    recorded = images * pixels * per_image + sweeps * SWEEP_BYTES * rays
    return round(recorded + world.key_frames * (views * pixels * TRUTH_BYTES + scans * SCAN_BYTES * rays))


def require_space(root: Path, needed: int) -> None:
    """Raises ResultError, one line, where the file system of `root` has less free space than `needed` bytes."""
    free = shutil.disk_usage(root).free
    if needed > free:
        raise ResultError(
            f"{root}: the world takes about {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free; free some space, set "
            "another datasets.<name>.dataroot, or make the world smaller (width, key_frames, cameras)"
        )
