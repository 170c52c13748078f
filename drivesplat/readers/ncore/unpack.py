"""Writes the images and sweeps of a clip as files, since later stages open each by its path, many times and in any
order: images/{camera}/{timestamp}.jpg (or what the clip has), its bytes unchanged, and sweeps/{lidar}/{timestamp}.npz.

They are written once, by the rule `extract`, one recording at a time, so that memory does not grow with the clip. A
rerun writes the same bytes.
"""

import dataclasses
import shutil
from pathlib import Path

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.io.storage import atomic_write
from drivesplat.readers.drive_checks import MAX_RANGE
from drivesplat.readers.ncore.clip import Clip, image_of, open_clip, rays_of, refusing
from drivesplat.readers.ncore.layout import clip_files
from drivesplat.readers.ncore.sweep_file import write_file
from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.settings.extract import SceneSource

FOLDERS = ("images", "sweeps")
SUFFIXES = {"jpeg": "jpg", "jpg": "jpg", "png": "png", "webp": "webp"}
"""Suffixes of files by the names of formats; those of others are `img`."""


def unpack(scene: Scene, root: Path, source: SceneSource, folder: Path) -> Scene:
    """Writes the images and sweeps of a scene that `reader.read` returned below `folder`, in place of those that are
    there. Returns the scene with their paths.

    Raises DatasetError naming the first recording that is damaged, and an image that is not there unless
    `source.on_missing` is 'warn'; ResultError naming a file that cannot be written.
    """
    for name in FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)
    clip = open_clip(clip_files(root, source.scene))
    frames = [_with_image(clip, frame, folder, source.on_missing == "stop") for frame in scene.frames]
    return dataclasses.replace(
        scene, frames=tuple(frames), sweeps=tuple(_with_rays(clip, sweep, folder) for sweep in scene.sweeps)
    )


def _with_image(clip: Clip, frame: Frame, folder: Path, stop: bool) -> Frame:
    """A frame whose image is a file below `folder`; with `stop` a missing one raises DatasetError."""
    found = image_of(clip, frame.camera, _end_of(frame.token))
    if found is None and stop:
        raise DatasetError(
            f"key frame {frame.sample_index}: image {frame.token} is not in the clip; copy it again, or set "
            "extract.on_missing: warn to go on without it"
        )
    content, kind = found or (None, "")
    path = folder / f"{frame.image_path}.{SUFFIXES.get(kind, 'img')}"
    if content is not None:
        with atomic_write(path) as file:
            file.write(content)
    return dataclasses.replace(frame, image_path=str(path))


def _with_rays(clip: Clip, sweep: Sweep, folder: Path) -> Sweep:
    """A sweep whose rays are a file below `folder`."""
    path = folder / sweep.path
    rays = rays_of(clip, sweep.lidar, _end_of(sweep.token))
    ranges = rays["range"].astype(np.float32)
    ranges[~((ranges > 0) & (ranges <= MAX_RANGE))] = np.nan
    stamps = rays["timestamp_us"].astype(np.float64)
    arrays = {
        "direction": rays["direction"].astype(np.float32),
        "range": ranges,
        "intensity": rays["intensity"].astype(np.float32),
        "time": (stamps - sweep.timestamp) * 1e-6,
    }
    elements = rays.get("model_element")
    if elements is not None:
        arrays |= {"row": elements[:, 0].astype(np.int32), "column": elements[:, 1].astype(np.int32)}
        arrays |= _model(clip, sweep)
    write_file(path, arrays)
    return dataclasses.replace(sweep, path=str(path))


def _model(clip: Clip, sweep: Sweep) -> dict[str, np.ndarray]:
    """The angles of the rays of a LiDAR's model; empty where it is unknown."""
    with refusing(f"LiDAR {sweep.lidar}: its model"):
        model = clip.intrinsics.get_lidar_model_parameters(sweep.lidar)
        if model is None or model.type() != "row-offset-spinning":
            return {}
        return {
            "row_elevations": model.row_elevations_rad,
            "column_azimuths": model.column_azimuths_rad,
            "row_offsets": model.row_azimuth_offsets_rad,
        }


def _end_of(token: str) -> int:
    """The end of a recording in microseconds, by which the clip names it: the last part of its token."""
    return int(token.rpartition("/")[2])
