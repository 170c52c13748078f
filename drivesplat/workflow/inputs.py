"""Input functions of rules: the files to read depend on the config."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args

from drivesplat.errors import ConfigError, DriveSplatError
from drivesplat.preprocess.segmentation.weights import weights_files
from drivesplat.provenance.file_digests import record_output
from drivesplat.readers.datasets import index, layout
from drivesplat.readers.truth import TRUTH_FILE
from drivesplat.scene.scene import REFINED
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.evaluate import BACKBONE, BACKBONE_RECORD
from drivesplat.settings.names import suggestion
from drivesplat.settings.segment import local_path
from drivesplat.settings.tracks import OTHER_TRACKS, TRACK_FOLDERS, Tracks
from drivesplat.settings.world import CameraChannel
from drivesplat.workflow.segmented import SEGMENTED, replaced_masks
from drivesplat.workflow.stages import SCAN_BASELINES, SCANS, refines_poses, training_inputs
from drivesplat.workflow.without_cameras import has_cameras
from drivesplat.workflow.without_tracks import methods_of


def unwritable_results(config: Config, error: OSError) -> DriveSplatError:
    """The error for a results folder that cannot be written."""
    return DriveSplatError(
        f"{config.results_dir}/: cannot be written ({error.strerror or error}); "
        "fix its permissions, or give this run another folder (results_dir)"
    )


class Inputs:
    """The inputs of a config's rules; `prefix` is put before the folder of the downloaded backbone."""

    def __init__(self, config: Config, prefix: str = ""):
        self.config = config
        self._prefix = prefix
        self._roots: dict[str, str] = {}
        self._indexed: set[str] = set()

    def tables(self, wildcards: Any) -> list[str]:
        """The tables that scene.json is made from; none where `scene_tables` gives the rows that it needs."""
        name = self.config.dataset_of(wildcards.scene)
        dataset = self.config.datasets[name]
        if dataset.world:
            return self.world_tables(name)
        if index(dataset.reader):
            return []
        files = layout(dataset.reader).table_files(Path(self._link(name)), dataset.version, wildcards.scene)
        return [str(file) for file in files]

    def scene_tables(self, wildcards: Any) -> list[str]:
        """The file of a scene's own rows of a recorded dataset's tables, where its reader splits them into scenes.
        Planning keeps it up to date, once, so that touched tables rerun nothing."""
        name = self.config.dataset_of(wildcards.scene)
        dataset = self.config.datasets[name]
        tables = None if dataset.world else index(dataset.reader)
        if tables is None:
            return []
        folder = Path(self.config.results_dir) / ".tables" / name
        if name not in self._indexed:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise unwritable_results(self.config, error) from error
            for file in tables.index_tables(Path(self._root(name)), dataset.version, dataset.scenes, folder):
                record_output(file, "extract", {}, {})
            self._indexed.add(name)
        return [str(tables.scene_file(folder, wildcards.scene))]

    def root(self, wildcards: Any) -> str:
        """The root of a scene's dataset as results name it: that of a recorded one is a link in the results folder,
        so that a dataset that has moved, or whose path is written in another way, reruns nothing."""
        name = self.config.dataset_of(wildcards.scene)
        return self._root(name) if self.config.datasets[name].world else self._link(name)

    def _link(self, name: str) -> str:
        """The link to the root of a recorded dataset, brought up to date; the root itself where links are refused."""
        link, root = Path(self.config.results_dir) / ".data" / name, Path(self._root(name)).absolute()
        try:
            if not link.is_symlink() or link.readlink() != root:
                link.parent.mkdir(parents=True, exist_ok=True)
                new = link.with_name(f".{name}-{os.getpid()}")
                new.symlink_to(root)
                new.replace(link)
        except OSError:
            return self._root(name)
        return str(link)

    def _root(self, name: str) -> str:
        if name not in self._roots:
            dataset = self.config.datasets[name]
            find_root = layout(dataset.reader).find_root
            found = dataset.world_root if dataset.world else find_root(dataset.dataroot, dataset.version)
            self._roots[name] = str(found)
        return self._roots[name]

    def refuse_unknown_cameras(self, name: str, cameras: Sequence[str]) -> None:
        """Raises ConfigError, with the cameras that a dataset has, if `cameras` names another one."""
        dataset = self.config.datasets[name]
        if not cameras:
            return
        if dataset.world:
            known = list(dataset.world.cameras or get_args(CameraChannel))
        else:
            known = layout(dataset.reader).camera_names(Path(self._root(name)), dataset.version)
        for camera in cameras:
            if not known:
                raise ConfigError(
                    f"dataset {name} has no camera, but cameras names {camera}; write cameras: [] and "
                    f"eval_camera: null into datasets.{name}.overrides to train on LiDAR alone (docs/lidar.md)"
                )
            if camera not in known:
                meant = suggestion(camera, known)
                raise ConfigError(
                    f"dataset {name} has no camera {camera!r} (cameras); {meant}there are: {', '.join(known)}"
                )

    @property
    def worlds(self) -> dict[str, str]:
        """The scenes of synthetic worlds, by the names of their datasets."""
        return {name: dataset.scenes[0] for name, dataset in self.config.datasets.items() if dataset.world}

    def world_tables(self, dataset: str) -> list[str]:
        """The declared files of a synthetic world."""
        world = self.config.datasets[dataset]
        return [f"{world.world_root}/{world.version}/{table}.json" for table in layout(world.reader).TABLES]

    def truth_file(self, dataset: str) -> str:
        """The ground-truth file of a synthetic world."""
        return f"{self.config.datasets[dataset].world_root}/{TRUTH_FILE}"

    def truth(self, wildcards: Any) -> list[str]:
        """The ground truth of a scene; none for recorded drives, and for blocks."""
        if self.config.is_block(wildcards.scene):
            return []
        name = self.config.dataset_of(wildcards.scene)
        return [self.truth_file(name)] if name in self.worlds else []

    def annotated_scene(self, wildcards: Any) -> str:
        """The scene record with annotated tracks, which figures are measured with: with refined poses if they are
        enabled."""
        name = REFINED if refines_poses(self.config, wildcards.scene) else "scene.json"
        return f"{self.config.results_dir}/{wildcards.scene}/{name}"

    def scene(self, wildcards: Any, shown: bool = False) -> str:
        """The scene record with the tracks of a job."""
        tracks = self.tracks(wildcards, shown)
        return self.annotated_scene(wildcards) if tracks == "annotated" else self._of(tracks, wildcards, "scene.json")

    def shown_scene(self, wildcards: Any) -> str:
        """The scene record with the tracks that pictures of a method show."""
        return self.scene(wildcards, shown=True)

    def shown_masks(self, wildcards: Any) -> str:
        return self._of(self.tracks(wildcards, shown=True), wildcards, "masks/masks.json")

    @property
    def other_tracks(self) -> list[str]:
        """The values of the wildcard `tracks` but that of annotated tracks, which is empty."""
        return [f"{folder}/" for folder in OTHER_TRACKS]

    def tracks(self, wildcards: Any, shown: bool = False) -> Tracks:
        """The tracks of a job: those of its results' folder, or those that its method trains with. Those that pictures
        show (`shown`) of a method without tracks are the annotated ones."""
        if hasattr(wildcards, "tracks"):
            own = next(tracks for tracks, name in TRACK_FOLDERS.items() if name == wildcards.tracks.rstrip("/"))
        else:
            own = self.config.all_methods[wildcards.method].tracks if hasattr(wildcards, "method") else "annotated"
        return "annotated" if shown and own == "none" else own

    def _of(self, tracks: Tracks, wildcards: Any, name: str) -> str:
        """A result of a scene that depends on tracks."""
        return str(Path(self.config.results_dir, wildcards.scene, TRACK_FOLDERS[tracks], name))

    def of_tracks(self, name: str) -> Callable[[Any], str]:
        """The function of wildcards that gives the result `name` for the tracks of a job."""
        return lambda wildcards: self._of(self.tracks(wildcards), wildcards, name)

    def first_parser(self, wildcards: Any) -> str:
        """The training record of the first method: cameras and splits are the same for all tracks."""
        return self._of(next(iter(methods_of(self.config, wildcards.scene).values())).tracks, wildcards, "parser.npz")

    def discovered(self, wildcards: Any) -> list[str]:
        """The discovered tracks of a scene, if those of the job are discovered or, without any, those of a method. None
        for a drive that is cut into blocks: they have their own."""
        if self.config.is_cut(wildcards.scene):
            return []
        alone = hasattr(wildcards, "tracks")
        of_any = (method.tracks for method in methods_of(self.config, wildcards.scene).values())
        wanted = "discovered" in ([self.tracks(wildcards)] if alone else of_any)
        return [f"{self.config.results_dir}/{wildcards.scene}/discovered.json"] if wanted else []

    def segmented(self, wildcards: Any) -> list[str]:
        """The record of a scene's maps by a network, if its masks use them."""
        used = replaced_masks(for_scene(self.config, wildcards.scene))
        return [f"{self.config.results_dir}/{wildcards.scene}/{SEGMENTED}/masks.json"] if used else []

    def network_files(self, wildcards: Any) -> list[str]:
        """The files of the segmentation network of a scene, if they are the user's own. Raises ConfigError where they
        are missing, or the settings name no network."""
        found = for_scene(self.config, wildcards.scene).segment
        if found.model is None:
            raise ConfigError(
                f"scene {wildcards.scene} has no maps by a network: segment.model is null; name one (docs/masks.md)"
            )
        path = local_path(found.model)
        return [] if path is None else [str(file) for file in weights_files(path)]

    def triangulated(self, wildcards: Any) -> list[str]:
        """The points triangulated by pose refinement, if seeds use them."""
        used = for_scene(self.config, wildcards.scene).lidar_seed.triangulated
        made = used and refines_poses(self.config, wildcards.scene)
        return [f"{self.config.results_dir}/{wildcards.scene}/triangulated.npz"] if made else []

    def points_file(self, wildcards: Any) -> list[str]:
        """The user's extra seed points, if given."""
        path = for_scene(self.config, wildcards.scene).lidar_seed.points_file
        return [str(Path(path).expanduser())] if path else []

    def of_images(self, name: str, of_tracks: bool = False) -> Callable[[Any], list[str]]:
        """The function of wildcards that gives a scene's result `name`, which is made from images: none without
        cameras. With `of_tracks` it depends on the tracks of a job."""

        def result(wildcards: Any) -> list[str]:
            if not has_cameras(self.config, wildcards.scene):
                return []
            return [self._of(self.tracks(wildcards) if of_tracks else "annotated", wildcards, name)]

        return result

    def training_input(self, stage: str) -> Callable[[Any], list[str]]:
        """The function of wildcards that gives the result of one of TRAINING_INPUTS, if the training reads it."""

        def result(wildcards: Any) -> list[str]:
            taken = training_inputs(self.config, wildcards.scene, wildcards.method)
            return [self._of(self.tracks(wildcards), wildcards, f"{stage}.npz")] if stage in taken else []

        return result

    def measured_scans(self, wildcards: Any) -> list[str]:
        """The scans with annotated objects, if a method renders LiDAR: its figures are measured with them."""
        rendered = self.renders_lidar(wildcards.scene, wildcards.method)
        return [f"{self.config.results_dir}/{wildcards.scene}/{SCANS}.npz"] if rendered else []

    def renders_lidar(self, scene: str, method: str) -> bool:
        return SCANS in training_inputs(self.config, scene, method)

    def scan_baselines(self, wildcards: Any) -> list[str]:
        """The baselines of a scene's LiDAR scans, if any method renders them. None for a drive that is cut into blocks:
        they have their own."""
        rendered = not self.config.is_cut(wildcards.scene) and any(
            self.renders_lidar(wildcards.scene, method) for method in methods_of(self.config, wildcards.scene)
        )
        return [f"{self.config.results_dir}/{wildcards.scene}/{SCAN_BASELINES}.json"] if rendered else []

    def actors(self, wildcards: Any) -> list[str]:
        """The actors of a scene and of the tracks of a job, if any method with these tracks has them."""
        tracks = self.tracks(wildcards)
        own = [name for name, method in methods_of(self.config, wildcards.scene).items() if method.tracks == tracks]
        taken = any("actors" in training_inputs(self.config, wildcards.scene, method) for method in own)
        return [self._of(tracks, wildcards, "actors.npz")] if taken else []

    def lpips_record(self, _: Any) -> list[str]:
        """The record of LPIPS's backbone, if LPIPS is enabled."""
        return [str(Path(self._prefix, BACKBONE_RECORD))] if self.config.lpips.enabled else []

    def backbone_file(self, _: Any) -> list[str]:
        """The backbone itself if it is present: adding it reruns the measurements that lacked it."""
        file = Path(self._prefix, BACKBONE)
        return [str(file)] if file.is_file() else []
