"""What a recording holds and what it lacks, a line each."""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drivesplat.cli.check.reading import CheckedScene, mean_rate
from drivesplat.readers.by_name import dataset_module
from drivesplat.readers.outline import Outline, RecordedCamera
from drivesplat.readers.record_names import counted
from drivesplat.readers.sweeps import SWEEP_FILE, read_returns, read_scan
from drivesplat.scene.scene import UNPOSED, Scene
from drivesplat.scene.scene_warnings import duration, max_displacement
from drivesplat.scene.sensors import Camera, Lidar, LidarReturns
from drivesplat.scene.tracks import moving_tracks

NO_IMAGES = "no images: methods that render LiDAR are trained and measured with cameras: [] (docs/lidar.md)"
NO_POSES = "no poses: set refine_poses: {enabled: true, start: images}"


class SweepColumns(NamedTuple):
    """What the sweeps of a LiDAR hold: `said` in words, and whether their rays are known."""

    said: str
    known_rays: bool


def contents(checked: CheckedScene, columns: dict[str, SweepColumns]) -> Iterator[str]:
    """What a recording holds."""
    scene = checked.whole
    yield summary(scene)
    moved = "" if scene.poses == UNPOSED else f", {max_displacement(scene):.0f} m from one end to the other"
    yield f"{duration(scene):.1f} s{moved}"
    for camera in scene.cameras:
        yield _camera(scene, camera)
    for lidar in scene.lidars:
        yield _lidar(scene, lidar, columns.get(lidar.name))
    if scene.tracks:
        moving = {track.id for track in moving_tracks(scene)}
        known = any((track.visibility > 0).any() for track in scene.tracks)
        of_moving = class_counts(track.object_class.value for track in scene.tracks if track.id in moving)
        yield (
            f"boxes: {class_counts(track.object_class.value for track in scene.tracks)}; moving: "
            f"{of_moving or 'none'}; visibility {'annotated' if known else 'unknown'}"
        )
    if scene.sky_class is not None or any(frame.classes_path for frame in scene.frames):
        yield "class maps of images"


def lacks(checked: CheckedScene, columns: dict[str, SweepColumns]) -> Iterator[str]:
    """What a recording lacks, with the consequence."""
    scene = checked.whole
    key_frames = sum(frame.is_key_frame for frame in scene.frames)
    if checked.faults_of_images:
        yield f"images: {_first(checked.faults_of_images)}; extract.on_missing: warn leaves such images out"
    if checked.faults_of_sweeps:
        yield (
            f"{counted(len(checked.faults_of_sweeps), 'sweep')}: {_first(checked.faults_of_sweeps)}; "
            "lidar_seed.on_missing: warn leaves such sweeps out"
        )
    if not scene.sweeps:
        yield (
            "LiDAR: seed points are triangulated from images, and methods know neither depth nor ground "
            "(lidar_seed: {on_missing: warn}, docs/own_data.md)"
        )
    for name, found in columns.items():
        if not found.known_rays:
            yield f"rings or beam_elevations of LiDAR {name}: methods that render LiDAR cannot use it (docs/lidar.md)"
    if not scene.tracks:
        yield "boxes: no figures of vehicles, and gap_db is null (docs/without_boxes.md)"
    elif not any((track.visibility > 0).any() for track in scene.tracks):
        yield "visibility of boxes: it is estimated from nearer boxes"
    if scene.poses == UNPOSED:
        yield f"{NO_POSES} (docs/poses.md)"
    if scene.frames and not any(camera.readout_s for camera in scene.cameras):
        yield "readout times of cameras: images are taken as those of a global shutter (docs/cameras.md)"
    if 0 < key_frames < len(scene.frames):
        between = len(scene.frames) - key_frames
        yield f"nothing between key frames: sweeps: true trains on {between} more images (docs/real_logs.md)"


def summary(scene: Scene) -> str:
    """What a recording holds, in a sentence."""
    key_frames = len(scene.key_frame_timestamps)
    images = f"{counted(len(scene.frames), 'image')} of {counted(len(scene.cameras), 'camera')}"
    parts = [
        counted(key_frames, "key frame") + (f" at {scene.key_frame_hz:g} Hz" if key_frames > 1 else ""),
        images if scene.frames else NO_IMAGES,
        counted(len(scene.sweeps), "LiDAR sweep") if scene.sweeps else "no LiDAR",
        *([NO_POSES] if scene.poses == UNPOSED else []),
        counted(len(scene.tracks), "track") if scene.tracks else "no boxes",
    ]
    return ", ".join(parts)


def sweep_columns(scene: Scene) -> dict[str, SweepColumns]:
    """What the sweeps of each LiDAR hold, by the first one whose file can be read."""
    found = {}
    for lidar in scene.lidars:
        sweep = next((sweep for sweep in scene.sweeps if sweep.lidar == lidar.name), None)
        if sweep is None:
            continue
        returns = read_returns(sweep)
        known = lidar.beam_elevations is not None or returns.rings is not None
        in_words = getattr(dataset_module(SWEEP_FILE, sweep.reader), "columns_sentence", None)
        said = in_words(Path(sweep.path)) if in_words else f"has {', '.join(_columns(returns))}"
        found[lidar.name] = SweepColumns(said, known or read_scan(sweep, lidar.spin) is not None)
    return found


def outline_of(scene: Scene, columns: dict[str, SweepColumns]) -> Outline:
    """The outline of a recording by its records."""
    images = Counter(frame.camera for frame in scene.frames)
    cameras = {one.name: RecordedCamera(one.width, one.height, images[one.name]) for one in scene.cameras}
    unknown = [name for name, found in columns.items() if not found.known_rays]
    return Outline(cameras, scene.key_frame_timestamps.tolist(), len(scene.sweeps), unknown)


def class_counts(names: Iterable[str]) -> str:
    """Things counted by their class, the most frequent first: '6 car, 3 pedestrian'."""
    return ", ".join(f"{number} {name}" for name, number in Counter(names).most_common())


def _camera(scene: Scene, camera: Camera) -> str:
    own = [frame for frame in scene.frames if frame.camera == camera.name]
    key_frames = [frame.timestamp for frame in own if frame.is_key_frame]
    rate = mean_rate([frame.timestamp for frame in own])
    lens = "rectified" if camera.distortion_model == "none" else f"lens {camera.distortion_model}, resampled"
    parts = [
        f"camera {camera.name}: {counted(len(own), 'image')} of {camera.width}x{camera.height}"
        + (f" at {rate:.3g} Hz" if rate else ""),
        *([f"{len(key_frames)} of them at key frames"] if len(key_frames) < len(own) else []),
        lens,
        *([f"read in {1e3 * camera.readout_s:.0f} ms"] if camera.readout_s else []),
        f"{_view_degrees(camera):.0f} degrees wide" if camera.distortion_model == "none" else "",
    ]
    return ", ".join(filter(None, parts))


def _lidar(scene: Scene, lidar: Lidar, columns: SweepColumns | None) -> str:
    times = [sweep.timestamp for sweep in scene.sweeps if sweep.lidar == lidar.name]
    rate = mean_rate(times)
    beams = "" if lidar.beam_elevations is None else f", {len(lidar.beam_elevations)} beams"
    said = f"LiDAR {lidar.name}: {counted(len(times), 'sweep')}" + (f" at {rate:.3g} Hz" if rate else "") + beams
    return said + (f"; the first {columns.said}" if columns else "")


def _view_degrees(camera: Camera) -> float:
    """The horizontal field of view of a pinhole camera."""
    return float(np.degrees(2.0 * np.arctan(camera.width / (2.0 * camera.intrinsics[0, 0]))))


def _columns(returns: LidarReturns) -> list[str]:
    known = {"intensity": returns.intensity, "ring": returns.rings, "time": returns.offsets_s}
    return ["x", "y", "z", *(name for name, values in known.items() if values is not None)]


def _first(faults: list[str]) -> str:
    more = " (the first)" if len(faults) > 1 else ""
    return faults[0] + more
