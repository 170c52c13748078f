"""The files that rules read, as functions of wildcards: which ones depends on the config."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from drivesplat.readers.datasets import layout
from drivesplat.readers.truth import TRUTH_FILE
from drivesplat.scene.scene import REFINED
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.evaluate import BACKBONE, BACKBONE_RECORD
from drivesplat.workflow.stages import refines_poses, training_inputs


class Inputs:
    """The inputs of a config's rules."""

    def __init__(self, config: Config):
        self.config = config
        self._tables: dict[str, list[str]] = {}

    def tables(self, wildcards: Any) -> list[str]:
        """The dataset files that decide a scene's scene.json."""
        name = self.config.dataset_of(wildcards.scene)
        if name not in self._tables:
            self._tables[name] = self._tables_of(name)
        return self._tables[name]

    def _tables_of(self, name: str) -> list[str]:
        dataset = self.config.datasets[name]
        files = layout(dataset.reader)
        if dataset.world:
            return [f"{dataset.world_root}/{dataset.version}/{table}.json" for table in files.TABLES]
        return [
            str(file) for file in files.table_files(files.find_root(dataset.dataroot, dataset.version), dataset.version)
        ]

    @property
    def worlds(self) -> dict[str, str]:
        """The scenes of synthetic worlds, by the names of their datasets."""
        return {name: dataset.scenes[0] for name, dataset in self.config.datasets.items() if dataset.world}

    def world_tables(self, dataset: str) -> list[str]:
        """The files that a synthetic world consists of, as far as rules know them."""
        return self.tables(SimpleNamespace(scene=self.worlds[dataset]))

    def truth_file(self, dataset: str) -> str:
        """Where the truth of a synthetic world is stated."""
        return f"{self.config.datasets[dataset].world_root}/{TRUTH_FILE}"

    def truth(self, wildcards: Any) -> list[str]:
        """The truth of a scene: recorded drives have none."""
        name = self.config.dataset_of(wildcards.scene)
        return [self.truth_file(name)] if name in self.worlds else []

    def scene(self, wildcards: Any) -> str:
        """The record of a scene that all stages take: with refined poses, where they are wanted."""
        name = REFINED if refines_poses(self.config, wildcards.scene) else "scene.json"
        return f"{self.config.results_dir}/{wildcards.scene}/{name}"

    def triangulated_seeds(self, wildcards: Any) -> list[str]:
        """The points that the refinement of poses triangulated, where they are to be seeds."""
        return self._triangulated(wildcards, for_scene(self.config, wildcards.scene).lidar_seed.triangulated)

    def triangulated_ends(self, wildcards: Any) -> list[str]:
        """The same points, where rays to them are to prove space empty."""
        return self._triangulated(wildcards, for_scene(self.config, wildcards.scene).free_space.triangulated)

    def _triangulated(self, wildcards: Any, wanted: bool) -> list[str]:
        made = wanted and refines_poses(self.config, wildcards.scene)
        return [f"{self.config.results_dir}/{wildcards.scene}/triangulated.pkl"] if made else []

    def points_file(self, wildcards: Any) -> list[str]:
        """The user's extra seed points, where given."""
        path = for_scene(self.config, wildcards.scene).lidar_seed.points_file
        return [str(Path(path).expanduser())] if path else []

    def actors(self, wildcards: Any) -> list[str]:
        """What the actors of a training are made of, where its method has any."""
        return self._training_input("actors", wildcards)

    def lidar_depth(self, wildcards: Any) -> list[str]:
        """LiDAR's depth in the training images, where a training is held to it."""
        return self._training_input("lidar_depth", wildcards)

    def free_space(self, wildcards: Any) -> list[str]:
        """The space that LiDAR's rays prove empty, where a training keeps Gaussians out of it."""
        return self._training_input("free_space", wildcards)

    def _training_input(self, stage: str, wildcards: Any) -> list[str]:
        taken = training_inputs(self.config, wildcards.scene, wildcards.method)
        return [f"{self.config.results_dir}/{wildcards.scene}/{stage}.pkl"] if stage in taken else []

    def lpips_record(self, _: Any) -> list[str]:
        """The record of LPIPS's backbone, where LPIPS is wanted."""
        return [BACKBONE_RECORD] if self.config.lpips.enabled else []

    def backbone_file(self, _: Any) -> list[str]:
        """The backbone itself, where it is there already: its arrival reruns what lacked it."""
        return [BACKBONE] if Path(BACKBONE).is_file() else []
