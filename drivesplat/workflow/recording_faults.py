"""What a recording lacks for the jobs of its scene, and what its images take, as far as its outline tells."""

import json
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from drivesplat.readers.outline import (
    Outline,
    RecordedCamera,
    frames_beyond,
    trained_key_frames,
    unknown_beams,
    unknown_camera,
    without_lidar,
    without_scans,
    without_training,
)
from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.stages import SCANS
from drivesplat.workflow.without_tracks import recorded_outline


def faults_of(config: Config, scene: str, rules: Collection[str]) -> Iterator[str]:
    """What the recording of a scene lacks for the jobs of some rules, a sentence each."""
    outline, settings = recorded_outline(config, scene), for_scene(config, scene)
    if outline is None or config.is_block(scene):
        return
    frames = _frames(config, scene)
    beyond = frames_beyond(scene, len(outline.key_frames), frames)
    if "extract" in rules:
        yield from filter(None, (unknown_camera(scene, outline.cameras, settings.cameras), beyond))
    if "lidar_seed" in rules:
        times = outline.key_frames[slice(*frames)] if frames else outline.key_frames
        if not settings.sweeps and not trained_key_frames(times, settings.holdout):
            yield without_training(scene, len(times))
        if not outline.sweeps and settings.lidar_seed.on_missing == "stop":
            yield without_lidar(scene)
    if SCANS in rules:
        if not outline.sweeps:
            yield without_scans(scene)
        yield from (f"scene {scene}, {unknown_beams(name)}" for name in outline.without_beams)


def image_gb(config: Config, scene: str) -> float | None:
    """The size of a scene's training images in memory, in GB, of those at key frames as far as these are trained on
    and, where `sweeps` is set, of the others in proportion; None while the images are unknown."""
    is_block = config.is_block(scene)
    outline, frames = None if is_block else recorded_outline(config, scene), _frames(config, scene)
    settings = for_scene(config, scene)
    if outline is None:
        outline, frames = _extracted(Path(config.results_dir, scene, "scene.json")), None
    if outline is None or not outline.key_frames:
        return None
    chosen = outline.key_frames[slice(*frames)] if frames else outline.key_frames
    trained = len(trained_key_frames(chosen, settings.holdout)) / len(outline.key_frames)
    cameras = [camera for camera in settings.cameras if camera not in settings.holdout.cameras]
    return trained * outline.image_bytes(cameras, settings.images, settings.sweeps) * 1e-9


def _frames(config: Config, scene: str) -> tuple[int, int] | None:
    """The range of key frames that is used of a scene: the first, and the last + 1."""
    return config.datasets[config.dataset_of(scene)].frames.get(scene)


def _extracted(file: Path) -> Outline | None:
    """The outline of a scene.json; None where there is none, or none that can be read."""
    try:
        scene = json.loads(file.read_text(encoding="utf-8"))
        images = Counter((frame["camera"], frame["width"], frame["height"]) for frame in scene["frames"])
        cameras = {name: RecordedCamera(*size, count) for (name, *size), count in images.items()}
        return Outline(cameras, scene["key_frame_timestamps"], len(scene["sweeps"]))
    except (AttributeError, KeyError, OSError, RecursionError, TypeError, ValueError):
        return None
