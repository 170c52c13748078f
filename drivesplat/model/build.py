"""A method's settings into a model: the only place that knows parts and skies by name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from drivesplat.model.actors import Actors
from drivesplat.model.background import Background
from drivesplat.model.camera_poses import TIMES, CameraPoses
from drivesplat.model.exposure import Exposures
from drivesplat.model.part import Part, Sky
from drivesplat.model.sky import ConstantSky, CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import ActorTrack
from drivesplat.scene.actor_record import motion_of
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import PartName, SkyKind, TrainSettings

EXPOSED = "exposure.first."
"""What the names of exposures' first gains begin with in a model's state; the camera follows."""
POSED = "camera_poses." + TIMES
"""And those of the times of corrected camera poses."""
FEW = 4
"""An actor keeps so many points of its seed whatever the cap: a Gaussian's first size is by its three neighbours."""


@dataclass(frozen=True)
class ModelInit:
    """What a model is initialised from: the scene's training `record`, those of its `actors` (empty where none are
    wanted), the mean colour (3,) in [0, 1] of its sky, the number of semantic `classes` (0: none), the initial gains
    (3,) of every camera in `exposed`, whose exposure is learned, and for every camera in `posed`, whose poses are
    corrected, the times of its training images in seconds."""

    record: TrainingRecord
    actors: list[dict[str, Any]]
    sky_color: np.ndarray
    classes: int = 0
    exposed: dict[str, np.ndarray] = field(default_factory=dict)
    posed: Mapping[str, Sequence[float]] = field(default_factory=dict)


def gaussian_cap(record: TrainingRecord, settings: TrainSettings) -> int:
    """The most Gaussians a scene's training images can hold: `cap_max`, or fewer where they have few pixels."""
    if not settings.pixels_per_gaussian:
        return settings.cap_max
    pixels = int(record.image_sizes[record.splits["train"]].prod(axis=1).sum())
    return max(1, min(settings.cap_max, int(pixels / settings.pixels_per_gaussian)))


def build_model(init: ModelInit, parts: tuple[PartName, ...], sky: SkyKind, settings: TrainSettings) -> SplatModel:
    """An untrained model. A part that has nothing to consist of (actors where nothing moves) is left out."""
    makers = {"background": _background, "actors": _actors}
    made = (makers[name](init, settings) for name in parts)
    return SplatModel(
        [part for part in made if part is not None],
        _sky(sky, settings, init.sky_color),
        settings.antialiased,
        _exposures(init.exposed, settings),
        _camera_poses(init.posed, settings),
    )


def definitions(model: SplatModel) -> list[dict[str, Any]]:
    """What `rebuild_model` needs of a model's parts, beside parameters: plain data and tensors."""
    return [{"part": part.name, **part.definition()} for part in model.parts]


def rebuild_model(
    state: Mapping[str, torch.Tensor], parts: list[dict[str, Any]], sky: SkyKind, settings: TrainSettings
) -> SplatModel:
    """The model whose `state_dict` is `state` and whose `definitions` are `parts`."""
    makers = {"background": _background_again, "actors": _actors_again}
    made = []
    for i, definition in enumerate(parts):
        prefix = f"parts.{i}.params."
        params = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
        made.append(makers[definition["part"]](params, definition, settings))
    exposed = {key.removeprefix(EXPOSED): gains for key, gains in state.items() if key.startswith(EXPOSED)}
    posed = {key.removeprefix(POSED): at.tolist() for key, at in state.items() if key.startswith(POSED)}
    model = SplatModel(
        made,
        _sky(sky, settings, np.full(3, 0.5)),
        settings.antialiased,
        _exposures(exposed, settings),
        _camera_poses(posed, settings),
    )
    model.load_state_dict(state)
    return model


def _background(init: ModelInit, settings: TrainSettings) -> Part:
    record = init.record
    kept = some_of(len(record.points), settings.cap_max)
    positions, colors = record.points[kept], record.points_rgb[kept] / 255.0
    return Background.from_points(positions, colors, settings.gaussians, record.scene_scale, init.classes)


def _background_again(params: dict[str, torch.Tensor], definition: dict[str, Any], settings: TrainSettings) -> Part:
    return Background(params, settings.gaussians, definition["extent"])


def _actors(init: ModelInit, settings: TrainSettings) -> Part | None:
    actors = [actor for actor in init.actors if len(actor["points"])]
    if not actors:
        return None
    tracks = [ActorTrack(actor["id"], actor["size"], motion_of(actor)) for actor in actors]
    limits = [actor_cap(actor, settings) for actor in actors]
    counts = [len(actor["points"]) for actor in actors]
    shares = shared_out(list(map(min, counts, limits)), settings.actors.cap_max)
    kept = [some_of(count, share) for count, share in zip(counts, shares, strict=True)]
    points, colors = (
        [actor[key][chosen] for actor, chosen in zip(actors, kept, strict=True)] for key in ("points", "points_rgb")
    )
    capped = settings.actors.model_copy(update={"cap_max": min(settings.actors.cap_max, sum(limits))})
    return Actors.from_points(tracks, points, [c / 255.0 for c in colors], capped, settings.gaussians, init.classes)


def actor_cap(actor: dict[str, Any], settings: TrainSettings) -> int:
    """The most Gaussians that the training pixels in an actor's box can hold."""
    if not settings.pixels_per_gaussian:
        return settings.actors.cap_max
    return max(settings.actors.least, int(actor["pixels"] / settings.pixels_per_gaussian))


def shared_out(wanted: Sequence[int], cap: int) -> list[int]:
    """How many of the Gaussians that each wants it may have, `cap` in all: FEW, or all if it wants fewer, and of those
    beyond the same fraction as the others. Where the cap has no room for FEW each, they have them nonetheless."""
    if sum(wanted) <= cap:
        return list(wanted)
    least = np.minimum(wanted, FEW)
    more = wanted - least
    room = max(0, cap - int(least.sum()))
    ends = np.cumsum([0, *more]) * room // max(1, int(more.sum()))
    return (least + np.diff(ends)).tolist()


def some_of(count: int, limit: int) -> np.ndarray:
    """Indices of at most `limit` of `count`, in order."""
    if count <= limit:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, limit, replace=False))


def _actors_again(params: dict[str, torch.Tensor], definition: dict[str, Any], settings: TrainSettings) -> Part:
    tracks = [ActorTrack.from_plain(plain) for plain in definition["tracks"]]
    return Actors(params, tracks, settings.actors, settings.gaussians)


def _exposures(first: Mapping[str, Any], settings: TrainSettings) -> Exposures | None:
    gains = {camera: torch.as_tensor(values).float().clone() for camera, values in first.items()}
    return Exposures(gains, settings.exposure) if gains else None


def _camera_poses(times: Mapping[str, Sequence[float]], settings: TrainSettings) -> CameraPoses | None:
    return CameraPoses(times, settings.camera_poses) if times else None


def _sky(kind: SkyKind, settings: TrainSettings, color: np.ndarray) -> Sky | None:
    start = torch.as_tensor(color, dtype=torch.float32)
    if kind == "cubemap":
        return CubemapSky(settings.sky_resolution, start, settings.lr_sky)
    if kind == "mask":
        return ConstantSky(start, settings.lr_sky)
    return None
