"""Writes the images and sweeps of a segment as files, since later stages open each by its path, many times and in any
order: images/{camera}/{timestamp}.jpg, the bytes of the dataset unchanged, classes/{camera}/{timestamp}.png, the
classes of labelled images, and sweeps/{laser}/{timestamp}.npz.

They are written once, by the rule `extract`, one recording at a time, so that memory does not grow with the segment. A
rerun writes the same bytes.
"""

import dataclasses
import shutil
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from drivesplat.errors import DatasetError
from drivesplat.io.storage import atomic_write
from drivesplat.readers.drive_checks import MAX_RANGE
from drivesplat.readers.waymo.calibration import laser_elevations, laser_mount, pose_of
from drivesplat.readers.waymo.layout import segment_files
from drivesplat.readers.waymo.names import CAMERAS, LASERS, MAX_CLASS, SKY_CLASS, UNDEFINED_CLASS
from drivesplat.readers.waymo.range_image import column_azimuth, points_of
from drivesplat.readers.waymo.reader import FORMATS
from drivesplat.readers.waymo.segment import ChosenRecordings, PanopticLabel, RangeImage, sweep_name
from drivesplat.readers.waymo.sweep_file import rays_of, write_file
from drivesplat.scene.images import DECODING_ERRORS, write_png
from drivesplat.scene.masks import UNLABELLED
from drivesplat.scene.scene import Scene
from drivesplat.settings.extract import SceneSource

FOLDERS = ("images", "classes", "sweeps")


def unpack(scene: Scene, root: Path, source: SceneSource, folder: Path) -> Scene:
    """Writes the images, class maps and sweeps of a scene that `reader.read` returned below `folder`, in place of those
    that are there. Returns the scene with their paths.

    Raises DatasetError naming the first range image that is damaged, and a frame without an image unless
    `source.on_missing` is 'warn'; ResultError naming a file that cannot be written.
    """
    for name in FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)
    files = segment_files(root, source.version, source.scene)
    images = {frame.token: folder / frame.image_path for frame in scene.frames}
    sweeps = {sweep.token: folder / sweep.path for sweep in scene.sweeps}
    classes: dict[str, str] = {}
    cameras = {name: number for number, name in CAMERAS.items()}
    lasers = {name: number for number, name in LASERS.items()}
    times = scene.key_frame_timestamps.tolist()
    wanted = ChosenRecordings(
        frozenset((times[frame.sample_index], cameras[frame.camera]) for frame in scene.frames),
        frozenset((times[sweep.sample_index], lasers[sweep.lidar]) for sweep in scene.sweeps),
    )
    for recording in FORMATS[files.version].read_recordings(files, wanted):
        if isinstance(recording, RangeImage):
            _write_sweep(recording, sweeps[f"{LASERS[recording.laser.number]}/{recording.frame}"])
            continue
        token = f"{CAMERAS[recording.camera]}/{recording.frame}"
        if isinstance(recording, PanopticLabel):
            path = folder / "classes" / CAMERAS[recording.camera] / f"{images[token].stem}.png"
            _write_classes(recording, path)
            classes[token] = str(path)
        elif recording.content:
            with atomic_write(images[token]) as file:
                file.write(recording.content)
    for frame in scene.frames if source.on_missing == "stop" else ():
        if not images[frame.token].is_file():
            camera, time = frame.token.split("/")
            raise DatasetError(
                f"key frame {frame.sample_index}: frame {time} has no image of camera {camera}; download the segment "
                "again, or set extract.on_missing: warn to go on without it"
            )
    return dataclasses.replace(
        scene,
        sky_class=SKY_CLASS if classes else None,
        frames=tuple(
            dataclasses.replace(frame, image_path=str(images[frame.token]), classes_path=classes.get(frame.token))
            for frame in scene.frames
        ),
        sweeps=tuple(dataclasses.replace(sweep, path=str(sweeps[sweep.token])) for sweep in scene.sweeps),
    )


def _write_classes(label: PanopticLabel, path: Path) -> None:
    """Writes the class of each pixel, UNLABELLED where Waymo's is undefined."""
    record = f"label {CAMERAS[label.camera]}/{label.frame}"
    try:
        with Image.open(BytesIO(label.content)) as image:
            panoptic = np.asarray(image)
    except DECODING_ERRORS as error:
        raise DatasetError(f"{record}: its panoptic label is corrupt ({error}); download the segment again") from error
    if label.divisor < 1 or panoptic.ndim != 2 or panoptic.max() // label.divisor > MAX_CLASS:
        raise DatasetError(
            f"{record}: its panoptic label has no classes from 0 to {MAX_CLASS} with the divisor {label.divisor}"
        )
    classes = panoptic // label.divisor
    write_png(path, np.where(classes == UNDEFINED_CLASS, UNLABELLED, classes).astype(np.uint8))


def _write_sweep(image: RangeImage, path: Path) -> None:
    """Writes a range image as rays, and as returns in the laser's frame at the pose of the frame. Waymo's ranges of
    dropped returns are not positive."""
    mount, sweep = laser_mount(image.laser), sweep_name(image.laser.number, image.frame)
    rows, columns, _ = image.values.shape
    if image.poses is not None and image.poses.shape[:2] != (rows, columns):
        raise DatasetError(
            f"{sweep}: its range image is {rows}x{columns}, and the poses of its pixels are "
            f"{image.poses.shape[0]}x{image.poses.shape[1]}; both must be of one segment"
        )
    azimuth = column_azimuth((np.arange(columns) + 0.5) / columns, mount)
    elevation = laser_elevations(image.laser, rows)
    ranges = image.values[..., 0].astype(np.float64)
    ranges[~((ranges > 0) & (ranges <= MAX_RANGE))] = np.nan
    rays = rays_of(azimuth, elevation, ranges)
    hit = np.isfinite(rays.range)
    poses = None if image.poses is None else image.poses.reshape(-1, 6)
    x, y, z = points_of(rays, mount, poses, pose_of(image.frame_pose, sweep)).T.astype(np.float32)
    # Waymo's intensities have no unit and no upper bound; most are below 1.
    values = np.nan_to_num(image.values[..., 1].ravel()[hit].astype(np.float64), nan=0.0)
    intensity, ring = np.tanh(values.clip(0.0)).astype(np.float32), rays.row[hit].astype(np.int16)
    write_file(path, azimuth, elevation, ranges, x=x, y=y, z=z, intensity=intensity, ring=ring)
