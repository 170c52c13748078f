"""The interface of the Snakefile to the library: settings and code digests of rules, and checks of targets.

Everything here must import and run quickly: it runs in the main process and in every job.
"""

import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from drivesplat import IS_CHECKOUT
from drivesplat.errors import ConfigError, DriveSplatError
from drivesplat.io.file_lock import LockHeldError, locked_file
from drivesplat.io.regular_file import regular_file
from drivesplat.io.storage import canonical_json
from drivesplat.readers.nuscenes.download.destination import RULE as DOWNLOAD
from drivesplat.readers.nuscenes.download.destination import download_job, require_permission
from drivesplat.settings.blocks import block_scene_name, drive_of
from drivesplat.settings.config import Config, for_scene, load
from drivesplat.settings.names import suggestion
from drivesplat.settings.tracks import OTHER_TRACKS
from drivesplat.workflow.film_names import (
    EDIT_TRUTH,
    EDITS,
    QUAD,
    TRAJECTORIES,
    no_such_edit,
    no_such_film,
    scene_edits,
)
from drivesplat.workflow.film_pages import FilmPages
from drivesplat.workflow.inputs import unwritable_results
from drivesplat.workflow.job_resources import JobResources
from drivesplat.workflow.long_drives import (
    chosen_lengths,
    refuse_results_of_blocks,
    require_cameras,
    require_left_out,
)
from drivesplat.workflow.named_tracks import edits_whole, refuse_other_tracks, refuse_wrong_tracks, track_references
from drivesplat.workflow.outputs import LIDAR, PARTS_FILM, SCRIPTS, TRUTH_FILM
from drivesplat.workflow.recordings import Recordings
from drivesplat.workflow.report_plan import ReportPlan
from drivesplat.workflow.runs_file import RUNS, no_such_run, runs_of
from drivesplat.workflow.segmented import SEGMENTED
from drivesplat.workflow.stages import stage_settings
from drivesplat.workflow.without_cameras import refuse_image_results, require_methods, scene_methods
from drivesplat.workflow.without_tracks import known_methods, methods_of
from drivesplat.world.marker import refuse_foreign_data

ABLATION_FILES = ("ablation.json", "ablation.csv")


def let_scripts_import(folder: str) -> None:
    """Makes the package at `folder`, if it is a checkout, importable for the scripts of all rules, in whatever
    environment they run. They find an installed package where Snakemake itself lies."""
    if not IS_CHECKOUT:
        return
    inherited = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([folder, *([inherited] if inherited else [])])


def idle_variants(config: Config, scene: str) -> list[str]:
    """The variants of the ablation that have the training settings of the whole method on a scene."""
    job = config.ablation.job
    whole, *others = (
        stage_settings(config, "train", scene, job.method(without, job.seeds[0])) for without in (None, *job.without)
    )
    return [without for without, settings in zip(job.without, others, strict=True) if settings == whole]


class Plan(JobResources):
    """The interface of the rules to the validated config; `basedir` is the Snakefile's folder, `prefix` is that of a
    module of another workflow, and `is_main` tells whether this process plans the run."""

    def __init__(self, values: Mapping[str, Any], basedir: str, prefix: str = "", is_main: bool = True):
        super().__init__(load(values), Path(basedir) / SCRIPTS, prefix, is_main)
        self.targets: list[str] | None = None
        """The targets of the run; None where they are not known."""
        self.recordings = Recordings(self)
        self._held_lock: Any = None

    def settings(self, stage: str) -> Callable[[Any], str]:
        """The function of wildcards that gives a stage's settings as canonical JSON."""

        def settings_of(wildcards: Any) -> str:
            names = ("method", "trajectory", "edit", "run")
            method, trajectory, edit, run = (getattr(wildcards, name, None) for name in names)
            folder = f"{wildcards.kind}/{wildcards.drive}" if hasattr(wildcards, "drive") else None
            return self.stage_settings(stage, wildcards.scene, method, trajectory or edit or run or folder)

        return settings_of

    def world_settings(self, dataset: str) -> str:
        """The settings of a dataset's synthetic world."""
        return self.stage_settings("demo_world", self.worlds[dataset])

    def download_settings(self, _: Any) -> str:
        """The settings of the download of nuScenes mini. Raises ConfigError where no dataset takes it."""
        return canonical_json(download_job(self.config).model_dump(mode="json"))

    def track_references(self, wildcards: Any) -> str:
        """Those of a job's tracks that a scene's settings name, as canonical JSON. A resource, not a param: it changes
        no result of the stages that check it."""
        references = track_references(self.config, wildcards.scene, self.targets, self.tracks(wildcards))
        return canonical_json(references.model_dump(mode="json"))

    def check_jobs(self, jobs: Iterable[Any]) -> None:
        """Prints which of Snakemake's planned `jobs` have images that exceed a GPU, and how long blocks are whose
        length is chosen. Raises ConfigError where one would fail on a track that settings name, or on what a recording
        lacks."""
        planned = list(jobs)
        for sentence in (*self.recordings.large_images(planned), *chosen_lengths(self.config, planned)):
            print(f"drivesplat: {sentence}", file=sys.stderr)
        self.recordings.refuse_unfit(planned)
        refuse_wrong_tracks(self.config, planned, self.shown_scene, self.recordings.has_same_world)

    def known(self, names: Any) -> str:
        """A wildcard constraint that matches only these names."""
        return "|".join(re.escape(name) for name in names) or "(?!)"

    def report(self, targets: list[str]) -> ReportPlan:
        """The plan of the report across scenes for these `targets`."""
        return ReportPlan(self, targets)

    def film_pages(self) -> FilmPages:
        """The pages of films for the targets of the run."""
        return FilmPages(self, lambda: self.targets)

    def refuse_unknown(self, targets: list[str]) -> None:
        """Raises ConfigError with the known names if a target names an unknown scene, method or film, or an ablation
        with a variant equal to the complete method."""
        ablation = self.config.ablation
        for target in targets:
            scene, *rest = self._inside_results(target)
            if not rest:
                continue
            self.config.dataset_of(scene)
            refuse_results_of_blocks(self.config, scene, rest)
            methods = methods_of(self.config, scene)
            if rest[0] in ABLATION_FILES and not self.config.ablated:
                raise ConfigError(
                    f"ablation.of names the method {ablation.of!r}, which is not in the config; there are: "
                    f"{', '.join(self.config.methods)}"
                )
            if len(rest) > 1 and rest[0] not in (*known_methods(self.config, scene), *OTHER_TRACKS, "masks", SEGMENTED):
                more = f"; for the ablation: {ablation.job.name_pattern}" if self.config.ablated else ""
                meant, known = suggestion(rest[0], methods), ", ".join(methods)
                raise ConfigError(f"method {rest[0]!r} is not in the config; {meant}there are: {known}{more}")
            films = (*for_scene(self.config, scene).render.trajectories, PARTS_FILM)
            refuse_image_results(self.config, scene, rest, films)
            idle = idle_variants(self.config, scene) if rest[0] in ABLATION_FILES else []
            if idle:
                drop = ", ".join(f"{name}: null" for name in idle)
                raise ConfigError(
                    f"on scene {scene} these variants take nothing out of {ablation.of!r} and would train it again as "
                    f"it is: {', '.join(idle)}; drop them with ablation: {{without: {{{drop}}}}}"
                )
            if len(rest) > 1 and rest[0] in known_methods(self.config, scene):
                self._refuse_unknown_film(scene, rest[0], rest[1:])

    def _refuse_unknown_film(self, scene: str, method: str, path: list[str]) -> None:
        """Raises ConfigError if `path` below a method's folder is an unknown film or edit."""
        own = methods_of(self.config, scene)
        if len(path) > 1 and path[0] == RUNS:
            runs, name = runs_of(self.config, scene, method), path[1].rpartition(".")[0] if len(path) == 2 else path[1]
            if name not in runs:
                raise ConfigError(no_such_run(scene, method, name, runs))
            return
        if len(path) > 2 and path[0] in (EDITS, TRAJECTORIES):
            self._refuse_unknown_drive(scene, method, path)
            return
        if path in ([f"{LIDAR}.png"], [f"{LIDAR}.mp4"], [f"{LIDAR}.json"]):
            if not self.renders_lidar(scene, method):
                able = ", ".join(name for name in own if self.renders_lidar(scene, name)) or "none"
                raise ConfigError(
                    f"method {method!r} renders no LiDAR of scene {scene} (train.scans.per_image is 0); those do: "
                    f"{able} (docs/lidar.md; presets/lidar.yaml adds street_lidar)"
                )
            return
        if path in ([f"{TRUTH_FILM}.mp4"], [f"{TRUTH_FILM}.json"]):
            self._require_truth(scene, path[0])
            return
        if path[0] == EDIT_TRUTH:
            self._require_truth(scene, "/".join(path))
        edit = Path(path[-1]).stem if len(path) == 2 and path[0] in (EDITS, QUAD, EDIT_TRUTH) else None
        film = path[0].removesuffix(".mp4").removesuffix(".cameras.json") if len(path) == 1 else path[-1]
        trajectory = for_scene(self.config, scene).render.trajectories.get(film)
        of_parts = film == PARTS_FILM or (trajectory is not None and trajectory.parts != "all")
        if of_parts and method not in self.methods_with_moving_parts:
            able = ", ".join(name for name in self.methods_with_moving_parts if name in own)
            raise ConfigError(
                f"method {method!r} has no moving parts that could be shown apart; those do: {able or 'none'}"
            )
        if edit is not None:
            self._refuse_unknown_edit(scene, method, edit)
        if film not in (path[-1], *self._film_names(scene, method)):
            raise ConfigError(no_such_film(for_scene(self.config, scene), f"scene {scene}", film))

    def _require_truth(self, scene: str, target: str) -> None:
        """Raises ConfigError if a scene of which a `target` needs the ground truth has none."""
        dataset = self.config.dataset_of(scene)
        world = self.config.datasets[dataset].world
        if world is None:
            raise ConfigError(f"{target} needs the truth of a synthetic world, and scene {scene} is none")
        if world.route is not None:
            raise ConfigError(
                f"{target} needs the truth of scene {scene}, and a world with a route has none; leave out the target, "
                f"or datasets.{dataset}.world.route"
            )

    def _refuse_unknown_drive(self, scene: str, method: str, path: list[str]) -> None:
        """Raises ConfigError if `path` below a method's folder is not the drive.json or the scans.json of an edit or a
        trajectory, or if the method renders no scans."""
        kind, name, *rest = path
        if rest in (["drive"], ["scans"]):
            folder = "/".join([self.config.results_dir, scene, method, *path])
            raise ConfigError(f"{folder} is a folder; ask for the file {folder}/{rest[0]}.json")
        if rest[:1] == ["scans"] and not self.renders_lidar(scene, method):
            able = [name for name in methods_of(self.config, scene) if self.renders_lidar(scene, name)]
            raise ConfigError(
                f"method {method!r} does not render LiDAR, so it has no scans; those do: {', '.join(able) or 'none'} "
                "(train.scans.per_image above 0, as in presets/lidar.yaml)"
            )
        if kind == EDITS:
            self._refuse_unknown_edit(scene, method, name)
            return
        trajectories = for_scene(self.config, scene).render.trajectories
        if name not in trajectories:
            raise ConfigError(no_such_film(for_scene(self.config, scene), f"scene {scene}", name))
        if trajectories[name].parts != "all":
            raise ConfigError(
                f"trajectory {name!r} shows the {trajectories[name].parts} parts alone; drive folders and scans "
                "show all: choose another trajectory"
            )

    def _refuse_unknown_edit(self, scene: str, method: str, edit: str) -> None:
        if method not in self.methods_with_actors:
            able = ", ".join(filter(methods_of(self.config, scene).__contains__, self.methods_with_actors)) or "none"
            raise ConfigError(f"method {method!r} knows no actors that could be edited; those do: {able}")
        if not edits_whole(self.config, scene, method):
            raise ConfigError(
                f"scene {scene} is cut into blocks, in each of which {method!r} finds its own objects: edit a block "
                f"({block_scene_name(scene, 0)}), or take a method with annotated tracks"
            )
        if edit not in scene_edits(self.config, scene):
            raise ConfigError(no_such_edit(scene, edit, scene_edits(self.config, scene)))
        refuse_other_tracks(self.config, scene, method, edit)

    def refuse_download(self, targets: list[str]) -> None:
        """Raises ConfigError if nuScenes mini is a target and may not be downloaded."""
        if DOWNLOAD in targets:
            require_permission(download_job(self.config))

    def refuse_absent_data(self, targets: list[str]) -> None:
        """Raises DatasetError if the dataset of a target's scene is not at the configured path, ConfigError if it lacks
        one of the cameras, if the scene has neither cameras nor a method that renders LiDAR, or if the points file is
        no file."""
        needing = [target for target in targets if target != DOWNLOAD]
        if targets and not needing:
            return
        named = [self._scene_of(target) for target in needing]
        of_batch = not named or any(scene is not None and not self.config.is_scene(scene) for scene in named)
        for scene in self.report(needing).scenes if of_batch else filter(None, named):
            of_scene = SimpleNamespace(scene=drive_of(scene) if self.config.is_block(scene) else scene)
            _ = self.tables(of_scene), self.scene_tables(of_scene)
            name = self.config.dataset_of(scene)
            require_methods(self.config, scene)
            require_cameras(self.config, drive_of(scene))
            require_left_out(self.config, drive_of(scene))
            self.refuse_unknown_cameras(name, for_scene(self.config, scene).cameras)
            # Snakemake names a points file that is absent; a job would wait for a pipe
            for path in self.points_file(of_scene):
                try:
                    regular_file(path)
                except FileNotFoundError:
                    pass
                except OSError as error:
                    raise ConfigError(f"lidar_seed.points_file {path}: {error}; name a PLY file of points") from None
            if self.config.datasets[name].world:
                refuse_foreign_data(Path(self.root(of_scene)))

    def scenes_and_methods(self, targets: list[str]) -> set[tuple[str, str]]:
        """The pairs of scene and method that targets concern, and every such scene with an empty method: those of the
        batch for a rule's name, a report or no target. Reads no result."""
        pairs: set[tuple[str, str]] = set()
        for target in targets or [""]:
            scene, (_, *rest) = self._scene_of(target), self._inside_results(target)
            if target == DOWNLOAD:
                continue
            if scene is not None and self.config.is_scene(scene):
                of_all = rest == ["metrics.json"]
                own = scene_methods(self.config, scene) if of_all else known_methods(self.config, scene)
                methods = [method for method in own if of_all or method in rest[:1]]
                pairs |= {(scene, method) for method in ("", *methods)}
            else:
                batch = self.config.batch_scenes
                pairs |= {(one, method) for one in batch for method in ("", *scene_methods(self.config, one))}
        return pairs

    def _scene_of(self, target: str) -> str | None:
        """The scene of a target: empty for a rule's name, None for a file outside the results of scenes."""
        for dataset, scene in self.worlds.items():
            made = (*self.world_tables(dataset), self.truth_file(dataset))
            if os.path.normpath(target) in map(os.path.normpath, made):
                return scene
        return self._inside_results(target)[0] or (None if os.sep in target else "")

    def _inside_results(self, target: str) -> list[str]:
        """The parts of a target's path below the results folder; one empty part if it is elsewhere."""
        path, results = (Path(os.path.normpath(name)) for name in (target, self.config.results_dir))
        return list(path.relative_to(results).parts) or [""] if path.is_relative_to(results) else [""]

    def hold_results(self) -> None:
        """Locks the results folder against a second run until this process ends, however it ends.

        Raises DriveSplatError if another run holds the lock.
        """
        folder = Path(self.config.results_dir)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._held_lock = locked_file(folder / ".lock")
        except OSError as error:
            raise unwritable_results(self.config, error) from error
        except LockHeldError:
            raise DriveSplatError(
                f"another run is working in {folder}/; wait for it, or give this one its own folder (results_dir)"
            ) from None
