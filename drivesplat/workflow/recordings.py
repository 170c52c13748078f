"""What is known of recordings before a run: which of its jobs they are unfit for, and what their images take."""

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from drivesplat.demo.marker import WORLD_MARKER
from drivesplat.errors import ConfigError
from drivesplat.readers.datasets import layout
from drivesplat.readers.outline import (
    Outline,
    frames_beyond,
    trained_key_frames,
    unknown_beams,
    unknown_camera,
    without_lidar,
    without_scans,
    without_training,
)
from drivesplat.settings.config import for_scene
from drivesplat.workflow.costs.measured import WORLD
from drivesplat.workflow.outputs import Outputs
from drivesplat.workflow.stages import SCANS

MAX_SCENES = 4
"""Maximum number of scenes that a refusal names."""


class Recordings:
    """The recordings of the scenes of a `plan`."""

    def __init__(self, plan: Outputs):
        self._config, self._plan = plan.config, plan
        self._outlines: dict[str, Outline | None] = {}

    def outline(self, scene: str) -> Outline | None:
        """The outline of a scene's recording; None where its reader gives none."""
        if scene not in self._outlines:
            self._outlines[scene] = self._read(scene)
        return self._outlines[scene]

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

    def has_same_world(self, scene: str) -> bool:
        """Whether a scene is that of a synthetic world which exists as it would be made again, but for its edits, which
        change none of its tracks."""
        name = self._config.dataset_of(scene)
        dataset = self._config.datasets[name]
        if not dataset.world:
            return False
        marker, extracted = Path(dataset.world_root, WORLD_MARKER), Path(self._config.results_dir, scene, "scene.json")
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
        outline, settings = self.outline(scene), for_scene(self._config, scene)
        if outline is None:
            return
        frames = self._config.datasets[self._config.dataset_of(scene)].frames.get(scene)
        beyond = frames_beyond(scene, outline, frames)
        if "extract" in rules:
            yield from filter(None, (unknown_camera(scene, outline, settings.cameras), beyond))
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

    def _read(self, scene: str) -> Outline | None:
        dataset = self._config.datasets[self._config.dataset_of(scene)]
        read = None if dataset.world else getattr(layout(dataset.reader), "outline", None)
        return read(Path(self._plan.root(SimpleNamespace(scene=scene))), dataset.version, scene) if read else None
