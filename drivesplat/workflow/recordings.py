"""What is known of recordings before a run: which of its jobs they are unfit for, and what their images take."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError
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
from drivesplat.settings.config import for_scene
from drivesplat.workflow.job_resources import JobResources
from drivesplat.workflow.stages import SCANS, TRAIN, WORLD
from drivesplat.workflow.without_tracks import recorded_outline
from drivesplat.world.marker import WORLD_MARKER

TRAINING_MB = 16_000
"""Memory in MB of a training without its images."""
MAX_SCENES = 4
"""Maximum number of scenes that a refusal names."""


class Recordings:
    """The recordings of the scenes of a `plan`."""

    def __init__(self, plan: JobResources):
        self._config, self._plan = plan.config, plan

    def refuse_unfit(self, jobs: Iterable[Any]) -> None:
        """Raises ConfigError, with a sentence for each scene, where one of Snakemake's planned `jobs` would fail on
        what the recording lacks."""
        planned: dict[str, set[str]] = defaultdict(set)
        for job in jobs:
            if hasattr(job.wildcards, "scene"):
                planned[job.wildcards.scene].add(job.rule.name)
        sentences = (next(self._faults(scene, rules), None) for scene, rules in planned.items())
        found = list(filter(None, sentences))
        if found:
            more = [f"{len(found) - MAX_SCENES} more scenes have such faults"] if len(found) > MAX_SCENES else []
            raise ConfigError(". ".join([*found[:MAX_SCENES], *more]))

    def image_gb(self, scene: str) -> float | None:
        """The size of a scene's training images in memory, in GB, of those at key frames as far as these are trained on
        and, where `sweeps` is set, of the others in proportion; None while the images are unknown."""
        is_block = self._config.is_block(scene)
        outline, frames = None if is_block else recorded_outline(self._config, scene), self._frames(scene)
        settings = for_scene(self._config, scene)
        if outline is None:
            outline, frames = _extracted(Path(self._config.results_dir, scene, "scene.json")), None
        if outline is None or not outline.key_frames:
            return None
        chosen = outline.key_frames[slice(*frames)] if frames else outline.key_frames
        trained = len(trained_key_frames(chosen, settings.holdout)) / len(outline.key_frames)
        cameras = [camera for camera in settings.cameras if camera not in settings.holdout.cameras]
        return trained * outline.image_bytes(cameras, settings.images, settings.sweeps) * 1e-9

    def training_mb(self, wildcards: Any) -> int:
        """The memory of a training on the host: its images, which are there on the CPU, and their masks beside what is
        needed whatever the images."""
        return TRAINING_MB + round(1000.0 * (self.image_gb(wildcards.scene) or 0.0))

    def large_images(self, jobs: Iterable[Any]) -> list[str]:
        """A sentence for each scene whose training images alone take more than the GPU memory that a training of the
        planned `jobs` requires before it starts."""
        scenes = dict.fromkeys(
            job.wildcards.scene for job in jobs if job.rule.name == TRAIN and self._plan.gpus(job.wildcards)
        )
        found = ((scene, self.image_gb(scene), for_scene(self._config, scene).device.min_free_gb) for scene in scenes)
        return [
            f"scene {scene}: its training images take {size:.1f} GB of GPU memory, and device.min_free_gb asks for "
            f"{free:g} GB alone; set images.width, or raise device.min_free_gb for a larger GPU"
            for scene, size, free in found
            if size is not None and size > free
        ]

    def has_same_world(self, scene: str) -> bool:
        """Whether a scene is that of a synthetic world which exists as it would be made again, but for its edits, which
        change none of its tracks."""
        name = self._config.dataset_of(scene)
        dataset = self._config.datasets[name]
        if not dataset.world:
            return False
        marker = Path(dataset.world_root, WORLD_MARKER)
        extracted = Path(self._config.results_dir, scene, "scene.json")
        try:
            if extracted.stat().st_mtime_ns < marker.stat().st_mtime_ns:
                return False
            made = json.loads(marker.read_text(encoding="utf-8"))["provenance"]["stages"][WORLD]
            planned = {"settings": json.loads(self._plan.stage_settings(WORLD, scene)), "code": self._plan.code(WORLD)}
            return all(record["settings"].pop("edits") is not None for record in (made, planned)) and made == planned
        except (AttributeError, KeyError, OSError, TypeError, ValueError):
            return False

    def _faults(self, scene: str, rules: set[str]) -> Iterator[str]:
        """What the recording of a scene lacks for the jobs of some rules, a sentence each."""
        outline, settings = recorded_outline(self._config, scene), for_scene(self._config, scene)
        if outline is None or self._config.is_block(scene):
            return
        frames = self._frames(scene)
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

    def _frames(self, scene: str) -> tuple[int, int] | None:
        """The range of key frames that is used of a scene: the first, and the last + 1."""
        return self._config.datasets[self._config.dataset_of(scene)].frames.get(scene)


def _extracted(file: Path) -> Outline | None:
    """The outline of a scene.json; None where there is none, or none that can be read."""
    try:
        scene = json.loads(file.read_text(encoding="utf-8"))
        images = Counter((frame["camera"], frame["width"], frame["height"]) for frame in scene["frames"])
        cameras = {name: RecordedCamera(*size, count) for (name, *size), count in images.items()}
        return Outline(cameras, scene["key_frame_timestamps"], len(scene["sweeps"]))
    except (AttributeError, KeyError, OSError, RecursionError, TypeError, ValueError):
        return None
