"""The settings that each stage of a scene, a method or a film gets: the param that Snakemake compares.

A stage is a rule; its record holds everything that decides its result, its inputs aside.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.io.storage import canonical_json
from drivesplat.settings import Settings
from drivesplat.settings.actor_seed import ActorSeedJob
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.dataset import DatasetSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.edits_file import read_edits
from drivesplat.settings.ego_mask import EgoMaskJob, EgoMaskSearch
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.settings.export import UsdJob, ViewerJob
from drivesplat.settings.extract import SceneSource
from drivesplat.settings.free_space import FreeSpaceJob
from drivesplat.settings.inspection import PanelJob, RemovalJob, SubjectSettings, TracksJob
from drivesplat.settings.lidar_depth import LidarDepthJob
from drivesplat.settings.lidar_seed import SeedJob
from drivesplat.settings.masks import MaskJob
from drivesplat.settings.parser import ParserJob
from drivesplat.settings.refine_poses import LidarRays, RefinePosesJob
from drivesplat.settings.render import EditJob, FilmFormat, FilmJob
from drivesplat.settings.train import STAGE_OF_PART, TrainJob
from drivesplat.settings.world import WorldJob

SCENE_STAGES = ("extract", "own_car", "lidar_seed", "parser", "masks", "scene_metrics")
METHOD_STAGES = ("train", "evaluate")
"""The stages behind every metrics.json, of a scene and of each of its methods."""
ALL_SCENE_STAGES = (*SCENE_STAGES, "refine_poses")
"""The stages of scenes whose poses are refined."""
SIDE_BY_SIDE = "scene_metrics"
"""The stage that combines eval.json files; none of them depends on it."""
OF_ONE_SCENE = ("demo_world", "extract", "edit", "ghost_panel", "remove_actor")
"""Stages whose settings depend on the scene itself; all others have the same for all scenes of a dataset."""
TRAINING_INPUTS = ("actors", "lidar_depth", "free_space")
"""Stages of a scene that only some methods train on."""


@dataclass(frozen=True)
class Place:
    """The dataset, scene, method and film (trajectory or edit) of a job, empty where it has none, and the config that
    applies to it. `scene` is also empty for stages that are not in OF_ONE_SCENE."""

    config: Config
    dataset_name: str
    scene: str
    method: str
    film: str

    @property
    def dataset(self) -> DatasetSettings:
        return self.config.datasets[self.dataset_name]

    @property
    def subject(self) -> SubjectSettings:
        """The vehicle that the user selected for the scene."""
        return self.config.subjects.get(self.scene, SubjectSettings())


def stage_settings(config: Config, stage: str, scene: str, method: str | None = None, film: str | None = None) -> str:
    """The canonical JSON of everything a stage of a scene (and method, and film) may know.

    Raises ValueError for a stage that there is none of, ConfigError for an unknown scene.
    """
    if stage not in _RECORDS:
        raise ValueError(f"no stage is called {stage!r}")
    there, dataset = for_scene(config, scene, method), config.dataset_of(scene)
    place = Place(there, dataset, scene if stage in OF_ONE_SCENE else "", method or "", film or "")
    return canonical_json(_RECORDS[stage](place).model_dump(mode="json"))


def refines_poses(config: Config, scene: str) -> bool:
    """Whether a scene's poses are refined before all other stages."""
    enabled, world = for_scene(config, scene).refine_poses.enabled, config.datasets[config.dataset_of(scene)].world
    return (world is None or world.pose_noise) if enabled == "auto" else enabled


def scene_stages(config: Config, scene: str) -> tuple[str, ...]:
    """The stages of a scene behind its metrics.json."""
    return ALL_SCENE_STAGES if refines_poses(config, scene) else SCENE_STAGES


def training_inputs(config: Config, scene: str, method: str) -> list[str]:
    """The stages of TRAINING_INPUTS that a method's training on a scene reads."""
    train = for_scene(config, scene, method).train
    stages_of_parts = {STAGE_OF_PART[part] for part in config.all_methods[method].moving_parts}
    taken = {
        "actors": "actors" in stages_of_parts,
        "lidar_depth": train.depth_weight > 0,
        "free_space": train.floaters.free_space,
    }
    return [stage for stage in TRAINING_INPUTS if taken[stage]]


def idle_variants(config: Config, scene: str) -> list[str]:
    """The variants of the ablation that have the training settings of the whole method on a scene."""
    job = config.ablation.job
    whole, *others = (
        stage_settings(config, "train", scene, job.method(without, job.seeds[0])) for without in (None, *job.without)
    )
    return [without for without, settings in zip(job.without, others, strict=True) if settings == whole]


def _extract(place: Place) -> SceneSource:
    config, dataset = place.config, place.dataset
    return SceneSource(
        dataset=place.dataset_name,
        reader=dataset.reader,
        version=dataset.version,
        scene=place.scene,
        frames=dataset.frames.get(place.scene),
        cameras=config.cameras,
        sweeps=config.sweeps,
        lidar_sweeps=config.lidar_seed.sweeps,
        on_missing=config.extract.on_missing,
    )


def _refine_poses(place: Place) -> RefinePosesJob:
    config, lidar = place.config, None
    if config.refine_poses.start == "images":
        lidar = LidarRays(ray_spacing=config.lidar_depth.ray_spacing, own_car_radius=config.lidar_seed.own_car_radius)
    return RefinePosesJob(refine_poses=config.refine_poses, random_seed=config.random_seed, lidar=lidar)


def _own_car(place: Place) -> EgoMaskJob:
    config, kind = place.config, place.config.masks.own_car
    polygons = config.masks.own_car_polygons if kind != "none" else {}
    spared = {"auto": {config.eval_camera}, "auto_measured": set()}.get(kind, set(config.cameras))
    cameras = tuple(camera for camera in config.cameras if camera not in {*polygons, *spared})
    search = EgoMaskSearch(cameras=cameras, holdout=config.holdout, own_car_radius=config.lidar_seed.own_car_radius)
    return EgoMaskJob(polygons=polygons, search=search if cameras else None)


def _lidar_seed(place: Place) -> SeedJob:
    config = place.config
    return SeedJob(
        lidar_seed=config.lidar_seed, holdout=config.holdout, images=config.images, random_seed=config.random_seed
    )


def _actors(place: Place) -> ActorSeedJob:
    config = place.config
    return ActorSeedJob(
        actors=config.actors,
        holdout=config.holdout,
        images=config.images,
        own_car_radius=config.lidar_seed.own_car_radius,
        random_seed=config.random_seed,
    )


def _lidar_depth(place: Place) -> LidarDepthJob:
    config = place.config
    return LidarDepthJob(
        ray_spacing=config.lidar_depth.ray_spacing,
        holdout=config.holdout,
        images=config.images,
        own_car_radius=config.lidar_seed.own_car_radius,
        box_margin=config.lidar_seed.box_margin,
    )


def _free_space(place: Place) -> FreeSpaceJob:
    config = place.config
    return FreeSpaceJob(
        free_space=config.free_space,
        holdout=config.holdout,
        own_car_radius=config.lidar_seed.own_car_radius,
        box_margin=config.lidar_seed.box_margin,
    )


def _train(place: Place) -> TrainJob:
    config, method = place.config, place.config.all_methods[place.method]
    train = config.train if method.moving_parts else config.train.without_moving_parts()
    reference = config.eval_camera if train.exposure.kind != "none" and len(config.cameras) > 1 else None
    return TrainJob(
        parts=method.parts, sky=config.sky, train=train, random_seed=config.random_seed, reference_camera=reference
    )


def _evaluate(place: Place) -> EvaluateJob:
    config = place.config
    return EvaluateJob(
        eval_camera=config.eval_camera,
        cameras=config.cameras,
        sweeps=config.sweeps,
        holdout=config.holdout,
        lidar=_lidar_depth(place),
        lpips=config.lpips.enabled,
        removal=config.removal if place.dataset.world else None,
    )


def _format(place: Place) -> dict[str, Any]:
    """The fields of a `FilmFormat`."""
    fields = ("fps", "width", "height", "horizontal_fov", "crf")
    return {"camera": place.config.eval_camera, **{name: getattr(place.config.render, name) for name in fields}}


def _film(place: Place) -> FilmJob:
    trajectories = place.config.render.trajectories
    if place.film not in trajectories:
        raise ConfigError(no_such_film(place.config, f"dataset {place.dataset_name}", place.film))
    return FilmJob(trajectory=trajectories[place.film], **_format(place))


def scene_edits(config: Config, scene: str) -> dict[str, Edit]:
    """The edits of a scene by name; empty without an edits file. Raises ConfigError if the file is invalid."""
    path = config.datasets[config.dataset_of(scene)].edits.get(scene)
    return read_edits(Path(path).expanduser()) if path else {}


def _edit(place: Place) -> EditJob:
    edits = scene_edits(place.config, place.scene)
    if place.film not in edits:
        raise ConfigError(no_such_edit(place.scene, place.film, edits))
    return EditJob(edit=edits[place.film], frames=place.config.render.edited_frames, **_format(place))


def no_such_edit(scene: str, name: str, edits: Iterable[str]) -> str:
    """The message about an unknown edit of a scene."""
    known = ", ".join(edits) or "none"
    return f"scene {scene} has no edit called {name!r}; there are: {known} (datasets.<name>.edits names its edits file)"


def no_such_film(config: Config, whose: str, name: str) -> str:
    """The message about an unknown film of a scene or dataset; `config` as it holds there."""
    known = ", ".join(config.render.trajectories)
    return f"{whose} has no film called {name!r}; there are: {known} (add it to render.trajectories)"


def _ghost_panel(place: Place) -> PanelJob:
    return PanelJob(eval_camera=place.config.eval_camera, subject=place.subject, ghosts=place.config.ghosts)


def _remove_actor(place: Place) -> RemovalJob:
    return RemovalJob(
        eval_camera=place.config.eval_camera,
        subject=place.subject,
        ghosts=place.config.ghosts,
        removal=place.config.removal,
    )


_RECORDS: dict[str, Callable[[Place], Settings]] = {
    "demo_world": lambda at: WorldJob(scene=at.scene, version=at.dataset.version, world=at.dataset.world),
    "extract": _extract,
    "own_car": _own_car,
    "refine_poses": _refine_poses,
    "lidar_seed": _lidar_seed,
    "parser": lambda at: ParserJob(holdout=at.config.holdout, images=at.config.images),
    "masks": lambda at: MaskJob(masks=at.config.masks, holdout=at.config.holdout, images=at.config.images),
    "actors": _actors,
    "lidar_depth": _lidar_depth,
    "free_space": _free_space,
    "train": _train,
    "evaluate": _evaluate,
    "scene_metrics": lambda _: Settings(),
    "ablation": lambda at: at.config.ablation.job,
    "tracks": lambda at: TracksJob(eval_camera=at.config.eval_camera),
    "film": _film,
    "film_parts": lambda at: FilmFormat(**_format(at)),
    "edit": _edit,
    "ghost_panel": _ghost_panel,
    "remove_actor": _remove_actor,
    "export": lambda _: Settings(),
    "export_usd": lambda at: UsdJob(eval_camera=at.config.eval_camera, gaussians=at.config.export.usd_gaussians),
    "export_viewer": lambda at: ViewerJob(
        eval_camera=at.config.eval_camera, gaussians=at.config.export.viewer_gaussians
    ),
}
