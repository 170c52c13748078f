"""What each stage of a scene, a method or a film gets of the config: the one param that Snakemake compares.

A stage is a rule; its record holds everything that decides its result, its inputs aside.
"""

from collections.abc import Callable
from dataclasses import dataclass

from drivesplat.config import Config, DatasetSettings, for_scene
from drivesplat.errors import ConfigError
from drivesplat.settings import Settings
from drivesplat.settings.actor import PanelJob, RemovalJob, SubjectSettings, TracksJob
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.settings.export import UsdJob, ViewerJob
from drivesplat.settings.extract import SceneSource
from drivesplat.settings.lidar_seed import SeedJob
from drivesplat.settings.masks import MaskJob
from drivesplat.settings.parser import ParserJob
from drivesplat.settings.render import FilmJob
from drivesplat.settings.train import TrainJob
from drivesplat.settings.world import WorldJob
from drivesplat.storage import canonical_json

SCENE_STAGES = ("extract", "lidar_seed", "parser", "masks", "scene_metrics")
METHOD_STAGES = ("train", "evaluate")
"""The stages behind a metrics.json, of a scene and of each of its methods."""


@dataclass(frozen=True)
class Place:
    """What a job is about; `config` as it holds there. A stage of a scene has no method, one of a method no film."""

    config: Config
    scene: str
    method: str
    trajectory: str

    @property
    def dataset(self) -> DatasetSettings:
        return self.config.datasets[self.config.dataset_of(self.scene)]

    @property
    def subject(self) -> SubjectSettings:
        """The vehicle that the user named for the scene."""
        return self.config.subjects.get(self.scene, SubjectSettings())


def stage_settings(
    config: Config, stage: str, scene: str, method: str | None = None, trajectory: str | None = None
) -> str:
    """The canonical JSON of everything a stage of a scene (and method, and film) may know.

    Raises ValueError for a stage that there is none of, ConfigError for an unknown scene.
    """
    if stage not in _RECORDS:
        raise ValueError(f"no stage is called {stage!r}")
    place = Place(for_scene(config, scene, method), scene, method or "", trajectory or "")
    return canonical_json(_RECORDS[stage](place).model_dump(mode="json"))


def _extract(place: Place) -> SceneSource:
    config, dataset = place.config, place.dataset
    return SceneSource(
        dataset=config.dataset_of(place.scene),
        reader=dataset.reader,
        version=dataset.version,
        scene=place.scene,
        frames=dataset.frames.get(place.scene),
        cameras=config.cameras,
        sweeps=config.sweeps,
        on_missing=config.extract.on_missing,
    )


def _lidar_seed(place: Place) -> SeedJob:
    config = place.config
    return SeedJob(
        lidar_seed=config.lidar_seed, holdout=config.holdout, images=config.images, random_seed=config.random_seed
    )


def _train(place: Place) -> TrainJob:
    config = place.config
    return TrainJob(
        parts=config.methods[place.method].parts, sky=config.sky, train=config.train, random_seed=config.random_seed
    )


def _evaluate(place: Place) -> EvaluateJob:
    config = place.config
    return EvaluateJob(
        eval_camera=config.eval_camera,
        cameras=config.cameras,
        sweeps=config.sweeps,
        holdout=config.holdout,
        lpips=config.lpips.enabled,
        removal=config.removal if place.dataset.world else None,
    )


def _film(place: Place) -> FilmJob:
    render = place.config.render
    if place.trajectory not in render.trajectories:
        raise ConfigError(no_such_film(place.config, place.scene, place.trajectory))
    return FilmJob(
        camera=place.config.eval_camera,
        trajectory=render.trajectories[place.trajectory],
        **{name: getattr(render, name) for name in ("fps", "width", "height", "horizontal_fov", "crf")},
    )


def no_such_film(config: Config, scene: str, name: str) -> str:
    """What to tell who asks for a film that there is none of; `config` as it holds for the scene."""
    known = ", ".join(config.render.trajectories)
    return f"scene {scene} has no film called {name!r}; there are: {known} (add it to render.trajectories)"


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
    "lidar_seed": _lidar_seed,
    "parser": lambda at: ParserJob(holdout=at.config.holdout, images=at.config.images),
    "masks": lambda at: MaskJob(masks=at.config.masks, images=at.config.images),
    "train": _train,
    "evaluate": _evaluate,
    "scene_metrics": lambda _: Settings(),
    "tracks": lambda at: TracksJob(eval_camera=at.config.eval_camera),
    "film": _film,
    "ghost_panel": _ghost_panel,
    "remove_actor": _remove_actor,
    "export": lambda _: Settings(),
    "export_usd": lambda at: UsdJob(eval_camera=at.config.eval_camera, gaussians=at.config.export.usd_gaussians),
    "export_viewer": lambda at: ViewerJob(
        eval_camera=at.config.eval_camera, gaussians=at.config.export.viewer_gaussians
    ),
}
