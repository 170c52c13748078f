"""Building a model from the settings of a method: the only module that knows parts and skies by name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from drivesplat.model.actors import Actors
from drivesplat.model.background import Background
from drivesplat.model.deformable import Deformable
from drivesplat.model.drifting import Drifting, drifting_seed
from drivesplat.model.exposure import Exposures, GainCurve, exposure_nodes
from drivesplat.model.height_field import HeightField
from drivesplat.model.parameters import random_subset, require_rows
from drivesplat.model.part import Part, PartDefinition, Sky
from drivesplat.model.road import EDGE, RoadPart, RoadSeed
from drivesplat.model.sky import ConstantSky, CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import ActorTrack
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import PartName, SkyKind, TrainSettings
from drivesplat.settings.train_objects import ActorSettings
from drivesplat.trajectories.actor_record import ActorRecord

FIRST_PREFIX, LEARNED_PREFIX, NODES = "exposure.first.", "exposure.params.", "exposure.nodes"
CURVE_PREFIX = "exposure.curve."
"""Of exposures in a model's state: prefixes of initial gains, of what is learned, and of initial gains over time, which
the camera name follows, and the times of nodes."""
OBJECTS: dict[str, type[Actors]] = {kind.name: kind for kind in (Actors, Deformable)}
"""The parts that consist of objects, by name."""
MIN_SEED_POINTS = 4
"""Seed points that an actor keeps whatever the cap: the initial scale of a Gaussian comes from three neighbours."""


@dataclass(frozen=True)
class ModelInit:
    """What a model is initialised from: the scene's training `record`, those of its `actors` (empty where none are
    wanted), the seed of the `road` (None: it is unknown or not wanted), the mean colour (3,) in [0, 1] of its sky, the
    number of semantic `classes` (0: none), the initial gains (3,) of every camera in `exposed`, whose exposure is
    learned, the `reference` camera, whose exposure is only learned over time (None: not), the initial `lidar_logits` of
    intensity and return (None: LiDAR is not rendered), the number of LiDAR `scans` that a training without images fits,
    and the `gain_curves` of cameras whose exposure changes over time."""

    record: TrainingRecord
    actors: list[ActorRecord]
    sky_color: np.ndarray
    classes: int = 0
    exposed: dict[str, np.ndarray] = field(default_factory=dict)
    reference: str | None = None
    lidar_logits: tuple[float, float] | None = None
    scans: int = 0
    road: RoadSeed | None = None
    gain_curves: Mapping[str, GainCurve] = field(default_factory=dict)

    @property
    def views(self) -> int:
        """The number of training images, or of scans without images."""
        return len(self.record.train_images) or self.scans


def gaussian_cap(record: TrainingRecord, settings: TrainSettings, rays: int = 0) -> int:
    """The maximum number of Gaussians for a scene's training images: `cap_max`, or fewer for images with few pixels.
    Without images the measured `rays` of its training scans count in place of pixels."""
    if not settings.pixels_per_gaussian:
        return settings.cap_max
    pixels = int(record.image_sizes[record.splits["train"]].prod(axis=1).sum())
    measured = pixels if len(record.image_sizes) else rays
    return max(1, min(settings.cap_max, int(measured / settings.pixels_per_gaussian)))


def build_model(init: ModelInit, parts: tuple[PartName, ...], sky: SkyKind, settings: TrainSettings) -> SplatModel:
    """An untrained model without the parts that would be empty, such as actors in a static scene."""
    made = (
        _init_objects(OBJECTS[name], init, parts, settings) if name in OBJECTS else _MAKERS[name](init, settings)
        for name in parts
    )
    return SplatModel(
        [part for part in made if part is not None],
        _sky(sky, settings, init.sky_color),
        settings.antialiased,
        _initial_exposures(init, settings),
        settings.rolling_shutter,
        settings.max_scale,
    )


def definitions(model: SplatModel) -> list[PartDefinition]:
    """What `rebuild_model` needs of a model's parts beside parameters."""
    return [part.definition() for part in model.parts]


def rebuild_model(
    state: Mapping[str, torch.Tensor], parts: list[PartDefinition], sky: SkyKind, settings: TrainSettings
) -> SplatModel:
    """The model whose `state_dict` is `state` and whose `definitions` are `parts`. Raises RuntimeError, ValueError or
    another error of lookups and types where they do not belong together."""
    made = []
    if not parts:
        raise ValueError("it has no parts")
    for i, definition in enumerate(parts):
        made.append(_rebuilt(_below(state, f"parts.{i}."), definition, settings))
    first = _below(state, FIRST_PREFIX)
    learned = tuple(key.removeprefix(LEARNED_PREFIX) for key in state if key.startswith(LEARNED_PREFIX))
    model = SplatModel(
        made,
        _sky(sky, settings, np.full(3, 0.5)),
        settings.antialiased,
        Exposures(first, settings.exposure, learned, state[NODES], _below(state, CURVE_PREFIX))
        if NODES in state
        else None,
        settings.rolling_shutter,
        settings.max_scale,
    )
    model.load_state_dict(state)
    return model


def _below(state: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}


def _rebuilt(state: dict[str, torch.Tensor], definition: PartDefinition, settings: TrainSettings) -> Part:
    params = _below(state, "params.")
    if definition.part not in OBJECTS:
        require_rows(params)
    if definition.part == Background.name:
        return Background(params, settings.gaussians, definition.extent)
    if definition.part == RoadPart.name:
        surface = HeightField(state["lower"], EDGE, state["heights"], state["covered"])
        return RoadPart(params, surface, settings.gaussians, definition.extent)
    own = getattr(settings, definition.part)
    if definition.part == Drifting.name:
        if definition.seconds is None:
            raise ValueError("its drifting Gaussians have no times")
        return Drifting(params, own, settings.gaussians, definition.extent, definition.seconds)
    require_rows(params, own.fourier, len(definition.tracks))
    return OBJECTS[definition.part](params, definition.tracks, own, settings.gaussians)


def _init_background(init: ModelInit, settings: TrainSettings) -> Part:
    record = init.record
    kept = random_subset(len(record.points), settings.cap_max)
    positions, colors = record.points[kept], record.points_rgb[kept] / 255.0
    return Background.from_points(
        positions,
        colors,
        settings.gaussians,
        record.scene_scale,
        init.classes,
        init.lidar_logits,
        init.lidar_logits is not None and settings.scans.fine_tune > 0,
    )


def _init_drifting(init: ModelInit, settings: TrainSettings) -> Part | None:
    """Drifting Gaussians at random places that the training images show; None without images."""
    record, own = init.record, settings.drifting
    times = [record.seconds(i) for i in record.train_images]
    if not times:
        return None
    count = max(MIN_SEED_POINTS, int(own.seed.fraction * own.fraction * settings.cap_max))
    seed = drifting_seed(record, own.seed, count, np.random.default_rng(0))
    seconds = min(times), max(times)
    return Drifting.from_seed(
        seed, own, settings.gaussians, record.scene_scale, seconds, init.classes, init.lidar_logits
    )


def _init_road(init: ModelInit, settings: TrainSettings) -> Part | None:
    if init.road is None:
        return None
    extent = init.record.scene_scale
    return RoadPart.from_seed(init.road, settings.gaussians, extent, init.classes, init.lidar_logits)


_MAKERS = {Background.name: _init_background, RoadPart.name: _init_road, Drifting.name: _init_drifting}
"""What makes the parts that do not consist of objects, by name."""


def _init_objects(
    kind: type[Actors], init: ModelInit, parts: Sequence[PartName], settings: TrainSettings
) -> Part | None:
    """The part of this kind with its objects among the actors, None without any."""
    actors = [actor for actor in init.actors if actor.part_in(parts) == kind.name and len(actor.points)]
    if not actors:
        return None
    own: ActorSettings = getattr(settings, kind.name)
    tracks = [ActorTrack(actor.id, actor.size, actor.motion, actor.object_class) for actor in actors]
    limits = [actor_cap(actor, own, settings.pixels_per_gaussian) for actor in actors]
    counts = [len(actor.points) for actor in actors]
    shares = split_cap(list(map(min, counts, limits)), own.cap_max)
    kept = [random_subset(count, share) for count, share in zip(counts, shares, strict=True)]
    chosen = list(zip(actors, kept, strict=True))
    points, colors = [actor.points[rows] for actor, rows in chosen], [actor.points_rgb[rows] for actor, rows in chosen]
    resolved = own.for_scene(sum(limits), len(actors), init.views)
    colors = [values / 255.0 for values in colors]
    return kind.from_points(tracks, points, colors, resolved, settings.gaussians, init.classes, init.lidar_logits)


def actor_cap(actor: ActorRecord, settings: ActorSettings, pixels_per_gaussian: float) -> int:
    """The maximum number of Gaussians for the training pixels in an actor's box."""
    if not pixels_per_gaussian:
        return settings.cap_max
    return max(settings.min_gaussians, int(actor.pixels / pixels_per_gaussian))


def split_cap(wanted: Sequence[int], cap: int) -> list[int]:
    """Splits `cap` Gaussians among actors that want so many: each gets up to MIN_SEED_POINTS, even beyond the cap, and
    the same fraction of the rest of its wish."""
    if sum(wanted) <= cap:
        return list(wanted)
    base = np.minimum(wanted, MIN_SEED_POINTS)
    rest = wanted - base
    left = max(0, cap - int(base.sum()))
    ends = np.cumsum([0, *rest]) * left // max(1, int(rest.sum()))
    return (base + np.diff(ends)).tolist()


def _initial_exposures(init: ModelInit, settings: TrainSettings) -> Exposures | None:
    if init.reference is None:
        return None
    record = init.record
    intervals = [settings.exposure.interval, *(curve.interval for curve in init.gain_curves.values())]
    interval = None if None in intervals else min(intervals)
    nodes = exposure_nodes([record.seconds(i) for i in record.train_images], interval)
    first = {camera: torch.as_tensor(gains).float() for camera, gains in init.exposed.items()}
    gain_curves = {
        camera: torch.as_tensor(curve.at(nodes.numpy())).float() for camera, curve in init.gain_curves.items()
    }
    exposures = Exposures(first, settings.exposure, (init.reference,), nodes, gain_curves if len(nodes) else {})
    return exposures if len(exposures.params) else None


def _sky(kind: SkyKind, settings: TrainSettings, color: np.ndarray) -> Sky | None:
    start = torch.as_tensor(color, dtype=torch.float32)
    if kind == "cubemap":
        return CubemapSky(settings.sky_resolution, start, settings.lr_sky)
    if kind == "mask":
        return ConstantSky(start, settings.lr_sky)
    return None
