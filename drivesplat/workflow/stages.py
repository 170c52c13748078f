"""The settings of each stage of a scene, method or film: the param that Snakemake compares.

A stage is a rule; its record holds everything but the inputs that determines its result.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.io.storage import canonical_json
from drivesplat.readers.datasets import reads_unposed
from drivesplat.settings import Settings
from drivesplat.settings.ablation import AblationJob
from drivesplat.settings.actor_seed import ActorSeedJob
from drivesplat.settings.blocks import BlocksJob, PooledJob
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.dataset import DatasetSettings
from drivesplat.settings.discover import DiscoverJob
from drivesplat.settings.evaluate import EvaluateJob, EvaluateScansJob
from drivesplat.settings.export import (
    AlpasimJob,
    AssetsJob,
    BlockSplatsJob,
    BlockUsdJob,
    DriveJob,
    ExportJob,
    FarJob,
    ScanFolderJob,
    SplatJob,
    ViewerJob,
)  # fmt: skip
from drivesplat.settings.extract import SceneSource
from drivesplat.settings.images import LightJob, ParserJob
from drivesplat.settings.lidar_depth import LidarDepthJob
from drivesplat.settings.lidar_seed import SeedJob
from drivesplat.settings.masks import EgoMaskJob, EgoMaskSearch, MaskJob, RegionJob
from drivesplat.settings.refine_poses import LidarRays, RefinePosesJob
from drivesplat.settings.render import (
    BlockEditJob,
    BlockFilmJob,
    CompareJob,
    EditJob,
    FilmFormat,
    FilmJob,
    LidarFilmJob,
    TruthFilmJob,
)
from drivesplat.settings.scans import ScansJob
from drivesplat.settings.segment import SegmentJob
from drivesplat.settings.simulate import RunJob
from drivesplat.settings.tracks import Tracks
from drivesplat.settings.train import STAGE_OF_PART, TrainJob
from drivesplat.settings.visuals import PanelJob, RemovalJob, SubjectSettings, TracksJob
from drivesplat.settings.world import WorldJob
from drivesplat.workflow.film_names import EDITS, no_such_edit, no_such_film, scene_edits
from drivesplat.workflow.named_tracks import fitting_edits, shows_subject, world_donors
from drivesplat.workflow.runs_file import code_of, no_such_run, runs_of
from drivesplat.workflow.segmented import mask_settings, segment_job
from drivesplat.workflow.without_cameras import (
    CAMERA_STAGES,
    HOW,
    LIDAR_METHOD_STAGES,
    LIDAR_SCENE_STAGES,
    has_cameras,
    no_camera,
)
from drivesplat.workflow.without_tracks import methods_of

TRAIN, WORLD = "train", "demo_world"
"""The stages of a training and of a synthetic world."""
SCENE_STAGES = ("extract", "own_car", "lidar_seed", "parser", "masks", "scene_metrics")
METHOD_STAGES = (TRAIN, "evaluate")
"""The stages behind every metrics.json, of a scene and of each of its methods."""
SIDE_BY_SIDE = "scene_metrics"
"""The stage that combines eval.json files; none of them depends on it."""
OF_ONE_SCENE = (
    WORLD, "extract", "masks", "edit", "quad", "edit_truth", "ghost_panel", "remove_actor", "export_viewer",
    "drive_folder", "scan_folder", "run", "run_folder", "evaluate_blocks", "film_blocks", "export_blocks",
    "edit_blocks", "usd_blocks",
)  # fmt: skip
"""Stages whose settings depend on the scene itself; all others have the same for all scenes of a dataset."""
SCANS, SCAN_BASELINES = "scans", "scan_baselines"
"""The stages of a scene's LiDAR scans, and of the figures that methods which render them have to beat."""
TRAINING_INPUTS = ("actors", "lidar_depth", SCANS)
"""Stages of a scene that only some methods train on."""


@dataclass(frozen=True)
class JobScope:
    """The dataset, scene, method and film (trajectory or edit; of a folder of a drive or of scans with its kind,
    'edits/…') of a job, empty where it has none, and the config that applies to it. `scene` is also empty for stages
    that are not in OF_ONE_SCENE."""

    config: Config
    dataset_name: str
    scene: str
    method: str
    film: str

    @property
    def dataset(self) -> DatasetSettings:
        return self.config.datasets[self.dataset_name]

    @property
    def tracks(self) -> Tracks:
        """The tracks that the method trains with; the annotated ones without a method."""
        return self.config.all_methods[self.method].tracks if self.method else "annotated"


def stage_settings(config: Config, stage: str, scene: str, method: str | None = None, film: str | None = None) -> str:
    """The canonical JSON of all settings of a stage, for a scene and, where given, a method and a film.

    Raises ValueError for an unknown stage, ConfigError for an unknown scene, and for one without the cameras that the
    stage needs.
    """
    if stage not in _STAGES:
        raise ValueError(f"no stage is called {stage!r}; add it to _STAGES in drivesplat/workflow/stages.py")
    there, dataset = for_scene(config, scene, method), config.dataset_of(scene)
    if not there.cameras and stage in CAMERA_STAGES:
        raise ConfigError(f"{no_camera(scene)}: the stage {stage} needs images")
    place = JobScope(there, dataset, scene if stage in OF_ONE_SCENE else "", method or "", film or "")
    return canonical_json(_record(stage, place).model_dump(mode="json"))


def _record(stage: str, place: JobScope) -> Settings:
    record, own_fields = _STAGES[stage]
    sections = {name: getattr(place.config, name) for name in record.model_fields if name in Config.model_fields}
    return record(**sections | own_fields(place))


def refines_poses(config: Config, scene: str) -> bool:
    """Whether a scene's poses are refined before all other stages. A block has those of its drive."""
    return not config.is_block(scene) and _refines(
        JobScope(for_scene(config, scene), config.dataset_of(scene), scene, "", "")
    )


def _refines(at: JobScope) -> bool:
    enabled, world = at.config.refine_poses.enabled, at.dataset.world
    if not at.config.cameras and at.config.refine_poses.start == "images":
        return False
    return (world is None or world.pose_noise) if enabled == "auto" else enabled


def stages_of_metrics(config: Config, scene: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The stages of a scene, and those of each of its methods, behind its metrics.json."""
    if config.is_cut(scene):
        return ("block", *SCENE_STAGES[1:]), (*METHOD_STAGES, "evaluate_blocks")
    refinement = ("refine_poses",) if refines_poses(config, scene) else ()
    of_scene = SCENE_STAGES if has_cameras(config, scene) else LIDAR_SCENE_STAGES
    return (*of_scene, *refinement), METHOD_STAGES if has_cameras(config, scene) else LIDAR_METHOD_STAGES


def training_inputs(config: Config, scene: str, method: str) -> list[str]:
    """The stages of TRAINING_INPUTS that a method's training on a scene reads."""
    train = for_scene(config, scene, method).train
    stages_of_parts = {STAGE_OF_PART[part] for part in config.all_methods[method].object_parts}
    taken = {
        "actors": "actors" in stages_of_parts,
        "lidar_depth": train.depth_weight > 0 and has_cameras(config, scene),
        SCANS: train.scans.per_image > 0,
    }
    return [stage for stage in TRAINING_INPUTS if taken[stage]]


def track_stages(config: Config, scene: str, method: str) -> list[str]:
    """The stages of a scene that give a method its tracks where these are not the annotated ones."""
    tracks = config.all_methods[method].tracks
    if tracks == "annotated":
        return []
    found = [SCANS, "discover"] if tracks == "discovered" else []
    return [*found, "relabel", *(["regions"] if has_cameras(config, scene) else [])]


def _nothing(_: JobScope) -> dict[str, Any]:
    return {}


def _scene_source(at: JobScope) -> dict[str, Any]:
    start = at.config.refine_poses.start
    return {
        "dataset": at.dataset_name,
        "reader": at.dataset.reader,
        "version": at.dataset.version,
        "scene": at.scene,
        "frames": at.dataset.frames.get(at.scene),
        "lidar_sweeps": at.config.lidar_seed.sweeps,
        "on_missing": at.config.extract.on_missing,
        "poses_from_images": reads_unposed(at.dataset.reader) and _refines(at) and start == "images",
    }


def _ego_mask(at: JobScope) -> dict[str, Any]:
    config, kind = at.config, at.config.masks.own_car
    polygons = config.masks.own_car_polygons if kind != "none" else {}
    excluded = {"auto": {config.eval_camera}, "auto_measured": set()}.get(kind, set(config.cameras))
    cameras = tuple(camera for camera in config.cameras if camera not in {*polygons, *excluded})
    search = EgoMaskSearch(cameras=cameras, holdout=config.holdout, **_lidar(at, "own_car_radius"))
    return {"polygons": polygons, "search": search if cameras else None}


def _lidar_rays(at: JobScope) -> dict[str, Any]:
    return {"lidar": LidarRays(ray_spacing=at.config.lidar_depth.ray_spacing, **_lidar(at, "own_car_radius"))}


def _lidar(at: JobScope, *names: str) -> dict[str, Any]:
    """Settings of the seed that hold for all uses of LiDAR."""
    return {name: getattr(at.config.lidar_seed, name) for name in names}


def _training(at: JobScope) -> dict[str, Any]:
    config, method = at.config, at.config.all_methods[at.method]
    train = config.train.for_parts(method.parts)
    if not config.cameras:
        # There is no image to spare.
        alone = {"per_image": float(train.scans.per_image > 0), "fine_tune": 0.0, "geometry": 1.0}
        scans = train.scans.model_copy(update=alone)
        return {"parts": method.parts, "sky": "none", "train": train.model_copy(update={"scans": scans})}
    exposure = train.exposure
    learned = exposure.kind != "none" and (len(config.cameras) > 1 or exposure.interval is not None)
    reference = config.eval_camera if learned else None
    return {"parts": method.parts, "train": train, "reference_camera": reference}


def _evaluation(at: JobScope) -> dict[str, Any]:
    return {
        "tracks": at.tracks,
        "lidar": _record("lidar_depth", at),
        "lpips": at.config.lpips.enabled,
        "removal": at.config.removal if at.dataset.world else None,
    }


def _viewer(at: JobScope) -> dict[str, Any]:
    """The edits of a method that can be edited, and the methods that have pages, too."""
    export, editable = at.config.export, at.config.all_methods[at.method].object_parts
    return {
        "gaussians": export.viewer_gaussians,
        "time_s": export.time_s,
        "image_width": export.viewer_images,
        "edits": fitting_edits(at.config, at.scene, at.tracks) if editable else {},
        "methods": tuple(sorted(methods_of(at.config, at.scene))),
    }


def _subject(at: JobScope) -> dict[str, Any]:
    """The vehicle that the user selected for the scene, if its track is one of those that pictures of the method
    show."""
    subject = at.config.subjects.get(at.scene, SubjectSettings())
    return {"subject": subject if shows_subject(subject, at.tracks) else SubjectSettings()}


def _world(at: JobScope) -> dict[str, Any]:
    """Raises ConfigError where an edit whose truth is asked for does not exist."""
    world, edits = at.dataset.world, scene_edits(at.config, at.scene)
    assert world is not None
    # the world of a drive that is cut has no truth of its own, and is not made again for an edit
    fitting = {} if at.dataset.blocks else fitting_edits(at.config, at.scene, "annotated")
    of_labels = [name for name, edit in fitting.items() if world_donors(at.config, edit) is not None]
    wanted = of_labels if world.truth.edits is None else world.truth.edits
    for name in wanted:
        if name not in edits:
            raise ConfigError(no_such_edit(at.scene, name, edits))
        if world_donors(at.config, edits[name]) is None:
            raise ConfigError(
                f"scene {at.scene}, edit {name!r}: its truth is not known, since it inserts what is in no synthetic "
                "world of the config; leave it out of world.truth.edits"
            )
    donors = {asset: donor for name in wanted for asset, donor in (world_donors(at.config, edits[name]) or {}).items()}
    return {
        "donors": donors,
        "scene": at.scene,
        "version": at.dataset.version,
        "world": world.with_sensors(at.config.cameras, at.config.sweeps, at.config.lidar_seed.sweeps),
        "edits": {name: edits[name] for name in wanted},
    }


def _film_format(at: JobScope) -> dict[str, Any]:
    """Of a `FilmFormat`."""
    fields = ("fps", "width", "height", "horizontal_fov", "crf", "captions", "end")
    return {"camera": at.config.eval_camera, **{name: getattr(at.config.render, name) for name in fields}}


def _film(at: JobScope) -> dict[str, Any]:
    """Of a `FilmJob`. Raises ConfigError for an unknown trajectory."""
    trajectories = at.config.render.trajectories
    if at.film not in trajectories:
        raise ConfigError(no_such_film(at.config, f"dataset {at.dataset_name}", at.film))
    return {"trajectory": trajectories[at.film], **_film_format(at)}


def _quad(at: JobScope) -> dict[str, Any]:
    """Of an `EditJob`, without `frames`. Raises ConfigError for an unknown edit."""
    edits = scene_edits(at.config, at.scene)
    if at.film not in edits:
        raise ConfigError(no_such_edit(at.scene, at.film, edits))
    return {"edit": edits[at.film], **_film_format(at)}


def _edit_or_trajectory(at: JobScope) -> dict[str, Any]:
    kind, _, name = at.film.partition("/")
    of_film = replace(at, film=name)
    return {"edit": _quad(of_film)["edit"]} if kind == EDITS else {"trajectory": _film(of_film)["trajectory"]}


def _drive_folder(at: JobScope) -> dict[str, Any]:
    """Of a `DriveJob`; raises as `_quad` or `_film`."""
    export = at.config.export
    return {**_edit_or_trajectory(at), "width": export.drive_width, "labels": export.drive_labels}


def _scan_folder(at: JobScope) -> dict[str, Any]:
    """Of a `ScanFolderJob`; raises as `_quad` or `_film`, and ConfigError for an edit of a scene without cameras."""
    camera = at.config.eval_camera if at.config.cameras else None
    if camera is None and at.film.startswith(f"{EDITS}/"):
        raise ConfigError(f"{no_camera(at.scene)}: scans of edits need images; {HOW}")
    return {**_edit_or_trajectory(at), "eval_camera": camera, "formats": at.config.export.scan_formats}


def _run(at: JobScope) -> dict[str, Any]:
    """Of a `RunJob`. Raises ConfigError for an unknown run."""
    runs = runs_of(at.config, at.scene, at.method)
    if at.film not in runs:
        raise ConfigError(no_such_run(at.scene, at.method, at.film, runs))
    run = runs[at.film]
    edit = None if run.edit is None else scene_edits(at.config, at.scene)[run.edit]
    return {"run": run, "edit": edit, "code": code_of(run.policy), "crf": at.config.render.crf}


def _usd(at: JobScope) -> dict[str, Any]:
    return {"gaussians": at.config.export.usd_gaussians, "time_s": at.config.export.time_s}


def _encoding(at: JobScope) -> dict[str, Any]:
    """How films that combine others are encoded."""
    return {name: getattr(at.config.render, name) for name in ("crf", "captions")}


_WITHOUT_SETTINGS = (
    "relabel", SCAN_BASELINES, "lidar_picture", "scene_metrics", "drive_mcap", "export_colmap", "export_spz",
    "export_sog", "viewer_blocks",
)  # fmt: skip
_STAGES: dict[str, tuple[type[Settings], Callable[[JobScope], dict[str, Any]]]] = {
    **dict.fromkeys(_WITHOUT_SETTINGS, (Settings, _nothing)),
    "demo_world": (WorldJob, _world),
    "extract": (SceneSource, _scene_source),
    "blocks": (BlocksJob, lambda at: {"blocks": at.dataset.blocks, "card": at.config.card(at.dataset_name)}),
    "block": (BlocksJob, lambda at: {"blocks": at.dataset.blocks}),
    "evaluate_blocks": (PooledJob, lambda at: {"left_out": at.dataset.left_out(at.scene)}),
    "own_car": (EgoMaskJob, _ego_mask),
    "refine_poses": (RefinePosesJob, _lidar_rays),
    "lidar_seed": (SeedJob, _nothing),
    "parser": (ParserJob, _nothing),
    "segment": (SegmentJob, lambda at: dict(segment_job(at.config))),
    "masks": (MaskJob, lambda at: {"masks": mask_settings(at.config, at.scene)}),
    "light": (LightJob, _nothing),
    "regions": (RegionJob, _nothing),
    "actors": (ActorSeedJob, lambda at: _lidar(at, "own_car_radius")),
    "lidar_depth": (
        LidarDepthJob,
        lambda at: {"ray_spacing": at.config.lidar_depth.ray_spacing} | _lidar(at, "own_car_radius", "box_margin"),
    ),
    SCANS: (ScansJob, lambda at: _lidar(at, "own_car_radius", "on_missing")),
    "discover": (DiscoverJob, _nothing),
    "lidar_film": (LidarFilmJob, _encoding),
    "train": (TrainJob, _training),
    "evaluate": (EvaluateJob, _evaluation),
    "evaluate_scans": (EvaluateScansJob, lambda at: {"tracks": at.tracks}),
    "ablation": (AblationJob, lambda at: dict(at.config.ablation.job)),
    "tracks": (TracksJob, _nothing),
    "film": (FilmJob, _film),
    "film_blocks": (BlockFilmJob, lambda at: {**_film(at), "left_out": at.dataset.left_out(at.scene)}),
    **dict.fromkeys(("film_parts", "recorded_frames"), (FilmFormat, _film_format)),
    "compare": (CompareJob, lambda at: {**_encoding(at), "end": at.config.render.end}),
    "truth_film": (TruthFilmJob, _encoding),
    "edit": (EditJob, lambda at: {**_quad(at), "frames": at.config.render.edited_frames}),
    "edit_blocks": (BlockEditJob, lambda at: {**_quad(at), "left_out": at.dataset.left_out(at.scene)}),
    **dict.fromkeys(("quad", "edit_truth"), (EditJob, _quad)),
    "drive_folder": (DriveJob, _drive_folder),
    "scan_folder": (ScanFolderJob, _scan_folder),
    **dict.fromkeys(("run", "run_folder"), (RunJob, _run)),
    "ghost_panel": (PanelJob, _subject),
    "remove_actor": (RemovalJob, _subject),
    "export_blocks": (
        BlockSplatsJob,
        lambda at: {"sh_degree": at.config.export.sh_degree, "left_out": at.dataset.left_out(at.scene)},
    ),
    "far_gaussians": (FarJob, lambda at: {"max_distance": at.config.export.max_distance}),
    "export": (SplatJob, lambda at: {name: getattr(at.config.export, name) for name in ("sh_degree", "time_s")}),
    "export_usd": (ExportJob, _usd),
    "usd_blocks": (BlockUsdJob, lambda at: {**_usd(at), "left_out": at.dataset.left_out(at.scene)}),
    "export_viewer": (ViewerJob, _viewer),
    "actor_assets": (AssetsJob, lambda at: {"complete": at.config.export.complete_assets}),
    "export_alpasim": (AlpasimJob, lambda at: {"body": at.config.export.vehicle}),
}
"""The record of every stage, and what gives its fields that are no sections of the config, or are changed for it."""
