"""What is known of recordings before a run: which of its jobs they are unfit for, and what their images take."""

import json
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.settings.config import for_scene
from drivesplat.workflow.job_resources import JobResources
from drivesplat.workflow.recording_faults import faults_of, image_gb
from drivesplat.workflow.stages import TRAIN, WORLD
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
        sentences = (next(faults_of(self._config, scene, rules), None) for scene, rules in planned.items())
        found = list(filter(None, sentences))
        if found:
            more = [f"{len(found) - MAX_SCENES} more scenes have such faults"] if len(found) > MAX_SCENES else []
            raise ConfigError(". ".join([*found[:MAX_SCENES], *more]))

    def image_gb(self, scene: str) -> float | None:
        """`recording_faults.image_gb` of a scene."""
        return image_gb(self._config, scene)

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
