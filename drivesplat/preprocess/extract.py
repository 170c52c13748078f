"""The stage `extract`: converts a dataset's tables to one validated `scene.json`."""

import dataclasses
import logging
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from drivesplat.errors import DatasetError
from drivesplat.preprocess.intrinsics import intrinsics_warnings
from drivesplat.preprocess.undistort import undistorted
from drivesplat.readers.datasets import reader, unpacker
from drivesplat.readers.drive_warnings import drive_warnings
from drivesplat.readers.image_file import image_fault
from drivesplat.scene.scene import Scene, place_of
from drivesplat.scene.scene_warnings import luminance, scene_warnings
from drivesplat.settings.extract import SceneSource

log = logging.getLogger(__name__)

MAX_NAMED = 10
"""Maximum number of skipped images that are logged one by one."""


def extract_scene(
    source: SceneSource, root: Path, scene_tables: Path | None = None, results: Path | None = None
) -> Scene:
    """Reads and checks a scene and decodes each of its images once; without cameras it has sweeps alone. Logs warnings
    about properties of the drive that affect its metrics.

    `root` holds the folder of tables, `scene_tables` the scene's extract of them (None: the reader finds it).
    Recordings that are no files of their own are written into the scene's folder `results`, and images of distorted
    cameras resampled into its folder `undistorted`. Raises DatasetError naming the token and path of the fault.
    """
    scene = reader(source.reader).read(root, source, scene_tables)
    if source.cameras and not scene.frames:
        raise DatasetError(
            f"scene {source.scene}: it has no image of {', '.join(source.cameras)}; name cameras that have some "
            "(cameras), or none (cameras: [] and eval_camera: null) to train on LiDAR alone (docs/lidar.md)"
        )
    if not scene.frames and not scene.sweeps:
        raise DatasetError(
            f"scene {source.scene}: it has no LiDAR sweep, and the settings name no camera (cameras: []); name cameras "
            "to train on images"
        )
    files = unpacker(source.reader)
    if files is not None:
        scene = files.unpack(scene, root, source, _folder(results, source))
    with ThreadPoolExecutor() as pool:
        faults = list(pool.map(image_fault, scene.frames))
    bad = [(frame, fault) for frame, fault in zip(scene.frames, faults, strict=True) if fault]
    if bad and source.on_missing == "stop":
        frame, fault = bad[0]
        no_sweeps = "" if frame.is_key_frame else "sweeps: false to do without all images between key frames, or "
        raise DatasetError(
            f"{place_of(frame)} ({frame.camera}): {fault}; "
            f"restore the file, or set {no_sweeps}extract.on_missing: warn to go on without it"
        )
    for frame, fault in bad[:MAX_NAMED]:
        log.warning("%s: %s; left out", place_of(frame), fault)
    if len(bad) > MAX_NAMED:
        log.warning("%d more of %d images are missing or corrupt; left out", len(bad) - MAX_NAMED, len(scene.frames))
    kept = tuple(frame for frame, fault in zip(scene.frames, faults, strict=True) if not fault)
    if scene.frames and not kept:
        raise DatasetError(
            f"scene {source.scene}: none of its {len(scene.frames)} images can be read (first: "
            f"{scene.frames[0].image_path})"
        )
    scene = dataclasses.replace(scene, dataset=source.dataset, frames=kept, missing_images=len(bad))
    of_cameras = intrinsics_warnings(scene)
    if any(camera.distortion_model != "none" for camera in scene.cameras):
        resampled = _folder(results, source) / "undistorted"
        shutil.rmtree(resampled, ignore_errors=True)
        scene = undistorted(scene, resampled)
    for sentence in (*of_cameras, *drive_warnings(scene), *scene_warnings(scene, luminance(scene))):
        log.warning("scene %s: %s", scene.name, sentence)
    return scene


def _folder(results: Path | None, source: SceneSource) -> Path:
    if results is None:
        raise DatasetError(f"scene {source.scene}: its images have to be written anew, and there is no folder for them")
    return results
