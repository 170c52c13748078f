"""What a run makes of the configured scenes, and what settings and code each result should come from."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from drivesplat.provenance.code_digest import code_digest
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.train import MOVING_PARTS
from drivesplat.workflow.inputs import Inputs
from drivesplat.workflow.stages import (
    METHOD_STAGES,
    SIDE_BY_SIDE,
    scene_edits,
    scene_stages,
    stage_settings,
    training_inputs,
)

SCRIPTS = "workflow_scripts"
PARTS_FILM = "parts"
"""The film of a method's parts."""


class Outputs(Inputs):
    """The results of a validated config; `scripts` is the folder of the rules' scripts."""

    def __init__(self, config: Config, scripts: Path):
        super().__init__(config)
        self._scripts = scripts

    def code(self, stage: str) -> str:
        """The digest of all code a stage runs."""
        return code_digest(self._scripts / f"{stage}.py")

    @property
    def all_trajectories(self) -> list[str]:
        """The names of all films of any scene."""
        films = (for_scene(self.config, scene).render.trajectories for scene in self.config.scenes)
        return list(dict.fromkeys(name for trajectories in films for name in trajectories))

    @property
    def methods_with_actors(self) -> list[str]:
        """The methods whose models know objects that move: those that can be taken apart and edited."""
        return [name for name, method in self.config.all_methods.items() if set(method.parts) & MOVING_PARTS]

    def films(self, scenes: list[str]) -> list[str]:
        """The films of every method of `scenes`, and those of the parts of methods that can be taken apart."""
        return self._films(scenes, self._films_of)

    def edits(self, scenes: list[str]) -> list[str]:
        """The films of every edit of `scenes`, by every method that can be edited."""
        return self._films(scenes, self._edits_of)

    def _films(self, scenes: list[str], names_of: Callable[[str, str], list[str]]) -> list[str]:
        return [
            f"{self.config.results_dir}/{scene}/{method}/{name}.mp4"
            for scene in scenes
            for method in self.config.methods
            for name in names_of(scene, method)
        ]

    def _films_of(self, scene: str, method: str) -> list[str]:
        parts = [PARTS_FILM] if method in self.methods_with_actors else []
        return [*for_scene(self.config, scene).render.trajectories, *parts]

    def _edits_of(self, scene: str, method: str) -> list[str]:
        edits = scene_edits(self.config, scene) if method in self.methods_with_actors else {}
        return [f"edits/{edit}" for edit in edits]

    def metrics_stages(self, scene: str) -> dict[str, Any]:
        """The settings and code that a scene's metrics.json should come from, by the names of the stages."""
        methods = self.evaluation_stages(scene, self.config.methods)
        return {**methods, SIDE_BY_SIDE: self._stage(SIDE_BY_SIDE, scene)}

    def evaluation_stages(self, scene: str, methods: Iterable[str]) -> dict[str, Any]:
        """The settings and code that every eval.json of `methods` should come from, by the names of the stages."""
        taken = {stage for method in methods for stage in training_inputs(self.config, scene, method)}
        made = (*scene_stages(self.config, scene), *sorted(taken))
        stages = {(stage, None): stage for stage in made if stage != SIDE_BY_SIDE}
        stages |= {(stage, method): f"{method}/{stage}" for method in methods for stage in METHOD_STAGES}
        return {name: self._stage(stage, scene, method) for (stage, method), name in stages.items()}

    def _stage(self, stage: str, scene: str, method: str | None = None) -> dict[str, Any]:
        return {"settings": json.loads(stage_settings(self.config, stage, scene, method)), "code": self.code(stage)}
