"""The results of the configured scenes, and the settings and code that each should come from."""

import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.io.storage import canonical_json, sha256_text
from drivesplat.provenance.code.code_digest import code_digest
from drivesplat.settings.asset_references import FOLDER, INDEX, LIGHT, asset_names, asset_of_results, files_of_asset
from drivesplat.settings.blocks import drive_of
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.export import ExportFormat
from drivesplat.settings.method import MethodSettings, merged
from drivesplat.settings.render import TrajectorySettings
from drivesplat.settings.tracks import TRACK_FOLDERS
from drivesplat.workflow.film_names import EDITS, QUAD, TRAJECTORIES, no_such_edit, scene_edits
from drivesplat.workflow.inputs import Inputs
from drivesplat.workflow.named_tracks import edits_whole, fitting_edits
from drivesplat.workflow.running_code import planned_digest
from drivesplat.workflow.runs_file import RUNS, config_runs, runs_of
from drivesplat.workflow.stages import (
    OF_ONE_SCENE,
    SCAN_BASELINES,
    SIDE_BY_SIDE,
    stage_settings,
    stages_of_metrics,
    track_stages,
    training_inputs,
)
from drivesplat.workflow.without_cameras import has_cameras, scene_methods
from drivesplat.workflow.without_tracks import methods_of

SCRIPTS = "workflow_scripts"
SPLATS = "splats/splats.json"
"""The index of the PLYs of a drive that is cut into blocks."""
NOTHING = "(?!)"
"""A wildcard constraint that nothing matches."""
LOOKS = ("ghost_panel.png", "removal.png")
LIDAR = "lidar"
"""The name of the picture and of the film of LiDAR scans of a method that renders them."""
LIDAR_LOOKS = (f"{LIDAR}.png",)
EXPORTS: dict[ExportFormat, tuple[str, ...]] = {
    "ply": ("splat.ply", "parts/parts.json"),
    "usd": ("scene.usdz",),
    "viewer": ("viewer.html",),
    "colmap": ("colmap/images.txt",),
    "spz": ("splat.spz",),
    "sog": ("splat.sog",),
    "alpasim": ("scene.alpasim.usdz",),
}
"""The files of every format, one or two for each rule that makes them."""
PARTS_FILM = "parts"
"""The film of a method's parts."""
TRUTH_FILM = "truth"
"""The film of a method beside the truth of a synthetic world. It is made on request."""
MCAP = "drive.mcap"
"""The file of a drive for ROS 2. It is made on request."""
RECORDED_FRAMES = "recorded_frames.npy"
"""The frames of the recorded drive, for the films of a method that show it."""
COMPARE_FILM = "compare.mp4"
"""The film of all methods of a scene."""


class Outputs(Inputs):
    """The results of a validated config; `scripts` is the folder of the rules' scripts, `prefix` as in `Inputs`, and
    `is_main` tells whether this process plans the run, not a job of it.

    Raises ConfigError where a job's process reads other settings than the run was planned with.
    """

    def __init__(self, config: Config, scripts: Path, prefix: str = "", is_main: bool = True):
        super().__init__(config, prefix)
        self._scripts, self._is_main = scripts, is_main
        settings = sha256_text(canonical_json(config.model_dump(mode="json")))
        if planned_digest(f"{scripts} {prefix}", lambda: settings, is_main) != settings:
            raise ConfigError("the settings changed since the run was planned; start again")
        self._codes: dict[str, str] = {}
        self._settings: dict[tuple[str | None, ...], str] = {}

    def code(self, stage: str) -> str:
        """The digest of all code a stage runs, as the run was planned."""
        if stage not in self._codes:
            script = self._scripts / f"{stage}.py"
            self._codes[stage] = planned_digest(str(script), lambda: code_digest(script), self._is_main)
        return self._codes[stage]

    def stage_settings(self, stage: str, scene: str, method: str | None = None, film: str | None = None) -> str:
        """`stage_settings` of the config, computed once per dataset where the scene itself does not matter."""
        key = (stage, scene if stage in OF_ONE_SCENE else self.config.dataset_of(scene), method, film)
        if key not in self._settings:
            self._settings[key] = stage_settings(self.config, stage, scene, method, film)
        return self._settings[key]

    @property
    def all_trajectories(self) -> list[str]:
        """The names of all films of any scene."""
        films = (for_scene(self.config, scene).render.trajectories for scene in self._first_scenes)
        return list(dict.fromkeys(name for trajectories in films for name in trajectories))

    @property
    def _first_scenes(self) -> list[str]:
        """A scene of each dataset: settings of a dataset are those of all of its scenes."""
        return [dataset.scenes[0] for dataset in self.config.datasets.values() if dataset.scenes]

    @property
    def methods_with_actors(self) -> list[str]:
        """The methods with parts that consist of objects: those that can be edited."""
        return [name for name, method in self.config.all_methods.items() if method.object_parts]

    @property
    def methods_with_moving_parts(self) -> list[str]:
        """The methods with dynamic parts: those that can be shown part by part."""
        return [name for name, method in self.config.all_methods.items() if method.moving_parts]

    @property
    def methods_with_lidar_in_any_scene(self) -> list[str]:
        """The methods that render LiDAR of any scene. Needs no config of each method and scene: most are never run."""
        given = {for_scene(self.config, scene).train.scans.per_image for scene in self._first_scenes}

        def renders(method: MethodSettings) -> bool:
            settings = (merged({"train": {"scans": {"per_image": own}}}, method.overrides) for own in given)
            return any(float(one["train"]["scans"]["per_image"]) > 0 for one in settings)

        return [name for name, method in self.config.all_methods.items() if renders(method)]

    def metrics(self, _: Any = None) -> list[str]:
        """The metrics.json of the batch's scenes."""
        return [f"{self.config.results_dir}/{scene}/metrics.json" for scene in self.config.batch_scenes]

    def films(self, _: Any = None, scenes: Iterable[str] | None = None) -> list[str]:
        """The films of every method of `scenes`, by default the batch's, of the parts of methods with moving ones,
        of LiDAR scans, of four panels where the settings name edits, and of all methods side by side. Raises
        ConfigError where they name an unknown edit."""
        chosen = self.config.batch_scenes if scenes is None else list(scenes)
        compared = [scene for scene in self._with_cameras(chosen) if for_scene(self.config, scene).render.compare]
        of_methods = self.of_methods(lambda *at: [f"{film}.mp4" for film in self._film_names(*at)], chosen, False)
        of_edits = self.of_methods(lambda *at: [f"{QUAD}/{edit}.mp4" for edit in self._quad_names(*at)], chosen)
        whole = [scene for scene in compared if not self.config.is_cut(scene)]
        of_drives = [
            f"{self.config.results_dir}/{scene}/{method}/{film}.mp4"
            for scene in self._with_cameras(one for one in chosen if self.config.is_cut(one))
            for method in scene_methods(self.config, scene)
            for film, trajectory in for_scene(self.config, scene).render.trajectories.items()
            if trajectory.parts == "all"
        ]
        films = [f"{self.config.results_dir}/{scene}/{COMPARE_FILM}" for scene in whole]
        return [*films, *of_drives, *of_methods, *of_edits]

    def edits(self, _: Any = None, scenes: Iterable[str] | None = None) -> list[str]:
        """The films of every edit of `scenes`, by default the batch's, and of blocks of these that have an edits file,
        by every method that can be edited. Raises ConfigError where an edits file is invalid."""
        of_edits = (scene for dataset in self.config.datasets.values() for scene in dataset.edits)
        chosen = self._with_blocks(scenes, of_edits)
        of_drives = [
            f"{self.config.results_dir}/{scene}/{method}/{EDITS}/{edit}.mp4"
            for scene in chosen
            if self.config.is_cut(scene)
            for method in scene_methods(self.config, scene)
            for edit in self._edit_names(scene, method)
        ]
        return of_drives + self.of_methods(
            lambda *at: [f"{EDITS}/{edit}.mp4" for edit in self._edit_names(*at)], chosen
        )

    def drives(self, _: Any = None) -> list[str]:
        """The rendered drive folders of the batch's scenes: of every edit, by every method that can be edited, and of
        every trajectory that shows all parts."""

        def names(scene: str, method: str) -> list[str]:
            trajectories = for_scene(self.config, scene).render.trajectories
            whole = [name for name, trajectory in trajectories.items() if trajectory.parts == "all"]
            folders = {EDITS: self._edit_names(scene, method), TRAJECTORIES: whole}
            return [f"{kind}/{name}/drive/drive.json" for kind, names in folders.items() for name in names]

        return self.of_methods(names)

    def assets(self, _: Any = None) -> list[str]:
        """The indices of the assets of the batch's scenes, of every method that can be edited."""
        return self.of_methods(lambda _, method: [f"{FOLDER}/{INDEX}"] if method in self.methods_with_actors else [])

    def runs(self, _: Any = None, scenes: Iterable[str] | None = None) -> list[str]:
        """The records of the runs in `scenes`, by default the batch's, and in blocks of these: there, of runs that name
        the block, or an edit of it."""

        def names(scene: str, method: str) -> list[str]:
            found, every = runs_of(self.config, scene, method), not self.config.is_block(scene)
            return [f"{RUNS}/{name}.json" for name, run in found.items() if every or run.scenes or run.edit]

        of_edits = (scene for dataset in self.config.datasets.values() for scene in dataset.edits)
        of_runs = (scene for run in config_runs(self.config).values() for scene in run.scenes or ())
        return self.of_methods(names, self._with_blocks(scenes, (*of_edits, *of_runs)))

    def mcap_files(self, _: Any = None) -> list[str]:
        """The MCAP files of the batch's scenes and methods: of the recorded path, of every edit and of every run."""

        def names(scene: str, method: str) -> list[str]:
            edits = [f"{EDITS}/{name}/" for name in self._edit_names(scene, method)]
            runs = [f"{RUNS}/{name}/" for name in runs_of(self.config, scene, method)]
            return [f"{place}{MCAP}" for place in ("", *edits, *runs)]

        return self.of_methods(names)

    def drive_of_mcap(self, wildcards: Any) -> str:
        """The drive folder of an MCAP file. Raises ConfigError where the one of the recorded path has no trajectory."""
        return f"{self._place_of_mcap(wildcards)}drive/drive.json"

    def scans_of_mcap(self, wildcards: Any) -> list[str]:
        """The rendered scans of an MCAP file, of a method that renders LiDAR. The drive folder of a run has its own."""
        if wildcards.at.startswith(RUNS) or not self.renders_lidar(wildcards.scene, wildcards.method):
            return []
        return [f"{self._place_of_mcap(wildcards)}scans/scans.json"]

    def _place_of_mcap(self, wildcards: Any) -> str:
        """The folder in which the drive folder of an MCAP file lies, with its slash."""
        at = wildcards.at
        if not at:
            trajectories = for_scene(self.config, wildcards.scene).render.trajectories
            recorded = [name for name, trajectory in trajectories.items() if trajectory == TrajectorySettings()]
            if not recorded:
                raise ConfigError(
                    f"scene {wildcards.scene}: {MCAP} is of the recorded path, which no trajectory follows; add "
                    "render: {trajectories: {original: {}}}"
                )
            at = f"{TRAJECTORIES}/{recorded[0]}/"
        return f"{self.config.results_dir}/{wildcards.scene}/{wildcards.method}/{at}"

    def inserts(self, wildcards: Any) -> list[str]:
        """The files of the assets that the edit of a job inserts, and of the light of its scene. Raises ConfigError for
        an asset of an unknown scene or of a method that has none."""
        kind, name = getattr(wildcards, "kind", EDITS), getattr(wildcards, "edit", None)
        if hasattr(wildcards, "run"):
            run = runs_of(self.config, wildcards.scene, wildcards.method).get(wildcards.run)
            name = run and run.edit
        elif name is None:
            name = wildcards.drive
        edit = scene_edits(self.config, wildcards.scene).get(name) if kind == EDITS and name else None
        if edit is None:
            return []
        names = asset_names(edit)
        for one in names:
            found = asset_of_results(one, wildcards.method)
            if found is not None and not self.config.is_scene(found[0]):
                raise ConfigError(f"edit {name!r} inserts asset {one!r}, and the config has no scene {found[0]!r}")
            if found is not None and found[1] not in self.methods_with_actors:
                able = ", ".join(self.methods_with_actors) or "none"
                raise ConfigError(f"edit {name!r} inserts asset {one!r}; methods with assets are: {able}")
        results = Path(self.config.results_dir)
        light = [results / wildcards.scene / LIGHT] if any(step.insert for step in edit.steps) else []
        assets = [file for one in names for file in files_of_asset(one, results, wildcards.method)]
        return [str(file) for file in (*assets, *light)]

    def recorded_frames(self, wildcards: Any) -> list[str]:
        """The file of the frames along the recorded path for a film that shows them; none where `render.recorded_once`
        is false, or the method cannot be edited."""
        render, trajectory = for_scene(self.config, wildcards.scene).render, getattr(wildcards, "trajectory", None)
        shows = trajectory is None or render.trajectories.get(trajectory) == TrajectorySettings()
        if not (render.recorded_once and shows and wildcards.method in self.methods_with_actors):
            return []
        return [f"{self.config.results_dir}/{wildcards.scene}/{wildcards.method}/{RECORDED_FRAMES}"]

    def looks(self, _: Any = None) -> list[str]:
        """The pictures of the batch's scenes and methods, and of the tracks of any method."""
        places = (
            Path(scene, TRACK_FOLDERS[own])
            for scene in self._with_cameras(self.config.batch_scenes)
            if not self.config.is_cut(scene)
            for own in dict.fromkeys(method.tracks for method in methods_of(self.config, scene).values())
            if own != "none"
        )
        tracks = [f"{self.config.results_dir}/{place}/tracks.png" for place in places]

        def names(scene: str, method: str) -> list[str]:
            of_images = LOOKS if has_cameras(self.config, scene) else ()
            return [*of_images, *(LIDAR_LOOKS if self.renders_lidar(scene, method) else ())]

        return [*tracks, *self.of_methods(names, cameras=False)]

    def exports(self, _: Any = None) -> list[str]:
        """The exported files of the batch's scenes and methods, in the formats of the settings."""
        cut = self._with_cameras(scene for scene in self.config.batch_scenes if self.config.is_cut(scene))
        pairs = ((scene, method) for scene in cut for method in scene_methods(self.config, scene))
        of_drives = [f"{self.config.results_dir}/{scene}/{method}/{SPLATS}" for scene, method in pairs]
        return of_drives + self.of_methods(
            lambda scene, _: [name for kind in for_scene(self.config, scene).export.formats for name in EXPORTS[kind]]
        )

    def alpasim(self, _: Any = None) -> list[str]:
        """The scenes for AlpaSim of the batch's scenes and methods."""
        return self.of_methods(lambda *_: EXPORTS["alpasim"])

    def of_methods(
        self, names: Callable[[str, str], Iterable[str]], scenes: Iterable[str] | None = None, cameras: bool = True
    ) -> list[str]:
        """The files below the folders of all methods of `scenes`, by default the batch's; `names` gives those of one
        scene and method. With `cameras` without those that have no camera. Without drives that are cut into blocks."""
        results, chosen = self.config.results_dir, self.config.batch_scenes if scenes is None else scenes
        shown = [one for one in (self._with_cameras(chosen) if cameras else chosen) if not self.config.is_cut(one)]
        places = ((scene, method) for scene in shown for method in scene_methods(self.config, scene))
        return [f"{results}/{scene}/{method}/{name}" for scene, method in places for name in names(scene, method)]

    def _with_blocks(self, scenes: Iterable[str] | None, named: Iterable[str]) -> list[str]:
        """`scenes`, by default the batch's, and those of their blocks that are among the `named` scenes."""
        chosen = self.config.batch_scenes if scenes is None else list(scenes)
        blocks = (scene for scene in dict.fromkeys(named) if self.config.is_block(scene))
        return [*chosen, *(scene for scene in blocks if drive_of(scene) in chosen)]

    def trained(self, cameras: bool | None = None) -> str:
        """The wildcard constraint of scenes with a model: those that are not cut into blocks, and blocks. With
        `cameras` those that have some, or those that have none."""
        scenes = [one for one in self.config.scenes if cameras in (None, has_cameras(self.config, one))]
        return self._any_of(
            *(rf"{re.escape(one)}\.\d\d\d+" if self.config.is_cut(one) else re.escape(one) for one in scenes)
        )

    @property
    def cut(self) -> str:
        """The wildcard constraint of drives that are cut into blocks."""
        return self._any_of(*(re.escape(one) for one in self.config.scenes if self.config.is_cut(one)))

    @property
    def blocks(self) -> str:
        """The wildcard constraint of their blocks."""
        return self._any_of(*(rf"{re.escape(one)}\.\d\d\d+" for one in self.config.scenes if self.config.is_cut(one)))

    def _any_of(self, *patterns: str) -> str:
        return "|".join(patterns) or NOTHING

    def _with_cameras(self, scenes: Iterable[str]) -> list[str]:
        return [scene for scene in scenes if has_cameras(self.config, scene)]

    def evals(self, wildcards: Any) -> list[str]:
        """The eval.json of every method of a scene."""
        folder = f"{self.config.results_dir}/{wildcards.scene}"
        return [f"{folder}/{method}/eval.json" for method in scene_methods(self.config, wildcards.scene)]

    def checkpoints(self, wildcards: Any) -> list[str]:
        """The checkpoints of every method of a scene."""
        folder = f"{self.config.results_dir}/{wildcards.scene}"
        return [f"{folder}/{method}/checkpoint.npz" for method in methods_of(self.config, wildcards.scene)]

    def _film_names(self, scene: str, method: str) -> list[str]:
        """The films of a method; those of some of its parts only if it has moving ones, those of images only of scenes
        with cameras."""
        settings = for_scene(self.config, scene).render
        lidar = [LIDAR] if settings.lidar and self.renders_lidar(scene, method) else []
        if not has_cameras(self.config, scene):
            return lidar
        if method in self.methods_with_moving_parts:
            return [*settings.trajectories, PARTS_FILM, *lidar]
        return [*(name for name, trajectory in settings.trajectories.items() if trajectory.parts == "all"), *lidar]

    def _edit_names(self, scene: str, method: str) -> Iterable[str]:
        if method not in self.methods_with_actors or not edits_whole(self.config, scene, method):
            return ()
        return fitting_edits(self.config, scene, self.config.all_methods[method].tracks)

    def _quad_names(self, scene: str, method: str) -> list[str]:
        """The edits whose films of four panels a method has by the settings: of scenes with an edits file."""
        wanted, known = for_scene(self.config, scene).render.quad, scene_edits(self.config, scene)
        for name in wanted if known else ():
            if name not in known:
                raise ConfigError(f"render.quad: {no_such_edit(scene, name, known)}")
        fitting = self._edit_names(scene, method)
        return [name for name in wanted if name in fitting]

    def metrics_stages(self, scene: str) -> dict[str, Any]:
        """The settings and code that a scene's metrics.json should come from, by the names of the stages."""
        own = scene_methods(self.config, scene)
        methods = self.evaluation_stages(scene, own)
        rendered = not self.config.is_cut(scene) and any(self.renders_lidar(scene, method) for method in own)
        combined = (*([SCAN_BASELINES] if rendered else []), SIDE_BY_SIDE)
        return {**methods, **{stage: self._stage(stage, scene) for stage in combined}}

    def evaluation_stages(self, scene: str, methods: Iterable[str]) -> dict[str, Any]:
        """The settings and code that every eval.json of `methods` should come from, by the names of the stages."""
        of_methods = (find(self.config, scene, name) for name in methods for find in (training_inputs, track_stages))
        taken = {stage for stages in of_methods for stage in stages}
        of_scene, of_method = stages_of_metrics(self.config, scene)
        made = (*of_scene, *sorted(taken))
        stages = {(stage, None): stage for stage in made if stage != SIDE_BY_SIDE}
        stages |= {(stage, method): f"{method}/{stage}" for method in methods for stage in of_method}
        return {name: self._stage(stage, scene, method) for (stage, method), name in stages.items()}

    def _stage(self, stage: str, scene: str, method: str | None = None) -> dict[str, Any]:
        return {"settings": json.loads(self.stage_settings(stage, scene, method)), "code": self.code(stage)}
