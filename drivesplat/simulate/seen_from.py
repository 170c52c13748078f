"""From where training images saw what a model shows: its static Gaussians, its objects, and the sky.

LiDAR scans take the place of images in `scan_validity`; a radian of them has one pixel.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from drivesplat.drive.recorded_drive import RecordedDrive
from drivesplat.drive.world_actor import WorldActor
from drivesplat.editing.placed_model import PlacedModel
from drivesplat.errors import RequestError
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View, view_of
from drivesplat.scene.images import read_image
from drivesplat.scene.rigid import inverse
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.training.unseen import MIN_WEIGHT
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.seen_sides import TimedCameras

SIMILAR = math.radians(20.0)
"""Angle in radians, at a Gaussian or an object, between a camera and a training camera that saw it, up to which the two
see it from a similar direction."""
OTHER_SIDE = math.radians(40.0)
"""Angle from which a side is shown that no training image saw; that of `drivesplat.editing.film.unseen_sides`."""
MAX_MAGNIFICATION = 2.0
"""Pixels per metre, as a multiple of those in a training image, up to which two images are of a similar scale. An image
from farther away always is."""
MIN_IMAGES = 2
"""Training images that must have seen something from a similar direction and at a similar scale."""
MAX_IMAGES, MAX_NEAREST = 256, 64
"""The training images of which it is known what they saw, evenly spread over all; and those of them, the nearest to a
camera, that are compared with it. Both bound memory and time."""
MAX_PAIRS = 2**22
"""Pairs of Gaussians and training images that are compared at once."""
NEARBY = 1.0
"""Metres by which training cameras may be farther away than the nearest one to give the angle of a camera."""
SKY_BINS = (60, 120)
"""Bins of the sky in elevation and azimuth, of 3 degrees."""
SKY_ALPHA = 0.5
"""Alpha below which a pixel shows the sky."""
Item = TypeVar("Item")


def reduced(view: View, max_side: int) -> View:
    """The same image with at most so many pixels along the longer side."""
    factor = min(1.0, max_side / max(view.width, view.height))
    width, height = max(1, round(factor * view.width)), max(1, round(factor * view.height))
    scales = view.K.new_tensor([width / view.width, height / view.height, 1.0])
    return replace(view, K=view.K * scales[:, None], width=width, height=height)


def may_show(view: View, gaussians: Gaussians) -> Int[Tensor, " m"]:
    """The indices of the Gaussians that reach into an image with three standard deviations, and of some others."""
    reach = 3.0 * gaussians.scales.amax(dim=1)
    x, y, depth = ((gaussians.means - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]).unbind(dim=1)
    shown, nearer = depth > -reach, (depth + reach).clamp(min=0.0)
    for along, size, axis in ((x, view.width, 0), (y, view.height, 1)):
        focal, middle = view.K[axis, axis], view.K[axis, 2]
        shown &= (along + reach >= -nearer * (middle / focal)) & (along - reach <= nearer * ((size - middle) / focal))
    return shown.nonzero()[:, 0]


@dataclass(frozen=True, eq=False)
class Sides:
    """The sides that a view shows of k Gaussians or objects: whether MIN_IMAGES training images saw them from a
    `similar` direction and at a similar scale, the angle `turn` (radians) to the nearest direction in which one saw
    them, at most OTHER_SIDE, which is a side that none saw, and the `magnification`: the pixels per metre as a multiple
    of the most that a training image had."""

    similar: Bool[Tensor, " k"]
    turn: Float[Tensor, " k"]
    magnification: Float[Tensor, " k"]

    @property
    def unseen(self) -> Bool[Tensor, " k"]:
        """Those that no training image saw from this side."""
        return self.turn >= OTHER_SIDE

    def __getitem__(self, chosen: Tensor) -> "Sides":
        return Sides(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class SeenGaussians:
    """What v training images saw of the n Gaussians of a model, the rows of all its parts in order: which images `seen`
    (n, v) which of them, those of objects without meaning; the places of their cameras (v, 3) in the world, metres,
    with their `focal` lengths in pixels; and the squared `errors` (n,) of colours in [0, 1] in the pixels that show
    each, nan where none does; None without the recorded images."""

    seen: Bool[Tensor, "n v"]
    centers: Float[Tensor, "v 3"]
    focal: Float[Tensor, " v"]
    errors: Float[Tensor, " n"] | None

    @torch.no_grad()
    def sides(
        self, means: Float[Tensor, "m 3"], rows: Int[Tensor, " m"], place: Float[Tensor, "3"], focal: Float[Tensor, ""]
    ) -> Sides:
        """The sides that a sensor at a `place` sees of the static Gaussians of these rows, which are now at `means`.
        `focal` are its pixels, or beams, per radian."""
        nearest = (self.centers - place).norm(dim=1).argsort()[:MAX_NEAREST].sort().values
        centers, finer, found = self.centers[nearest] - place, focal / self.focal[nearest], []
        all_seen = self.seen[rows] if len(nearest) == len(self.centers) else self.seen[rows[:, None], nearest]
        step = max(1, MAX_PAIRS // len(nearest))
        for first in range(0, max(len(means), 1), step):
            # With the camera at the origin, all that is needed follows from products of places.
            own, seen = means[first : first + step] - place, all_seen[first : first + step]
            along, square = own @ centers.T, own.square().sum(dim=1, keepdim=True)
            inverse_distance = square.clamp(min=1e-9).rsqrt()
            trained = (square - 2.0 * along + centers.square().sum(dim=1)).clamp_(min=1e-9).sqrt_()
            cosine = torch.where(seen, (square - along) * inverse_distance / trained, -1.0)
            magnification = torch.where(seen, trained * (finer * inverse_distance), torch.inf)
            similar = (cosine >= math.cos(SIMILAR)) & (magnification <= MAX_MAGNIFICATION)
            best, number = cosine.max(dim=1)
            across = torch.linalg.cross(own, centers[number]).norm(dim=1)  # exact where both cameras are at one place
            turn = torch.atan2(across, (square - along).gather(1, number[:, None])[:, 0])
            turn = torch.where(best > math.cos(OTHER_SIDE), turn, OTHER_SIDE).clamp(max=OTHER_SIDE)
            found.append(Sides(similar.sum(dim=1) >= MIN_IMAGES, turn, magnification.amin(dim=1)))
        return _joined(found)


@dataclass(frozen=True, eq=False)
class TrainingCameras:
    """The `places` (v, 3) of the cameras of training images in the world, metres, and their optical `axes` (v, 3); and
    the ends (s, 2, 3) of the `segments` of the recorded paths, from image to image of a camera, whether for training or
    held out."""

    places: Float[Tensor, "v 3"]
    axes: Float[Tensor, "v 3"]
    segments: Float[Tensor, "s 2 3"]

    @classmethod
    def of(cls, record: TrainingRecord, device: torch.device) -> "TrainingCameras":
        """Those of a drive. A camera with one image has a path without length."""
        segments: list[Any] = []
        for camera in np.unique(record.camera_indices):
            own = np.flatnonzero(record.camera_indices == camera)
            own = own[np.argsort(record.timestamps[own], kind="stable")]
            segments += zip(own, [*own[1:], own[-1]], strict=True)
        poses = torch.from_numpy(record.camtoworlds).float().to(device)
        trained = poses[torch.tensor(record.train_images)]
        return cls(trained[:, :3, 3], trained[:, :3, 2], poses[:, :3, 3][torch.tensor(np.array(segments))])

    def distance_and_angle(self, view: View) -> tuple[float, float]:
        """The distance (metres) of a camera to the nearest one, and the angle (degrees) between their axes: the least,
        of those at most NEARBY farther away."""
        distances = (self.places - view.camera_to_world[:3, 3]).norm(dim=1)
        nearby = self.axes[distances <= distances.min() + NEARBY]
        across = torch.linalg.cross(nearby, view.camera_to_world[:3, 2].expand_as(nearby)).norm(dim=1)
        angles = torch.atan2(across, nearby @ view.camera_to_world[:3, 2])
        return float(distances.min()), float(torch.rad2deg(angles.min()))

    def aside(self, view: View) -> float:
        """The distance (metres) of a camera to the paths."""
        start, along = self.segments[:, 0], self.segments[:, 1] - self.segments[:, 0]
        toward = view.camera_to_world[:3, 3] - start
        share = (toward * along).sum(dim=1) / along.square().sum(dim=1).clamp(min=1e-9)
        return float((toward - share.clamp(0.0, 1.0)[:, None] * along).norm(dim=1).min())


@dataclass(frozen=True, eq=False)
class SeenSky:
    """The `bins` of the sky (elevation, azimuth) that training images showed, and those beside them; and the mean
    squared `error` of colours in [0, 1] in their pixels, None without the recorded images."""

    bins: Bool[Tensor, "e a"]
    error: float | None

    def known(self, view: View) -> Float[Tensor, "h w"]:
        """1 for the pixels in whose direction training images showed the sky, 0 for others."""
        return self.bins.flatten()[_bins_of(view.rays())].float()


def training_images(record: TrainingRecord) -> list[int]:
    """The indices of at most MAX_IMAGES training images, evenly spread."""
    return evenly_chosen(record.train_images)


def evenly_chosen(items: Sequence[Item]) -> list[Item]:
    """At most MAX_IMAGES of these, evenly spread."""
    chosen = np.linspace(0, len(items) - 1, min(len(items), MAX_IMAGES)).round().astype(int)
    return [items[i] for i in chosen]


def recorded_image(record: TrainingRecord, folder: Path, index: int) -> Path:
    """The file of a recorded image, which may be missing: relative paths begin in the workflow's folder, the current
    one or the one that contains the folder of results, of which `folder` is a method's."""
    path = Path(record.image_paths[index])
    elsewhere = [workflow / path for workflow in folder.absolute().parents[2:3]]
    return next((found for found in (path, *elsewhere) if found.is_file()), path)


@torch.no_grad()
def seen_by_training(
    recording: RecordedDrive, folder: Path, model: SplatModel, device: torch.device, images: Sequence[int]
) -> tuple[SeenGaussians, SeenSky]:
    """What these training images saw of the model of the method with this result folder, as recorded. An image saw a
    Gaussian whose weights in its pixels, without those that the vehicle's own body covers, sum to MIN_WEIGHT pixels.
    Without the files of the recorded images there are no errors."""
    record = recording.record
    paths = [recorded_image(record, folder, index) for index in images]
    has_files = all(path.is_file() for path in paths)
    views = [view_of(record, index, device) for index in images]
    sky, of_sky = torch.zeros(SKY_BINS, dtype=torch.bool, device=device), torch.zeros(2, device=device)
    seen, sums = [], torch.zeros(2, sum(part.row_count for part in model.parts), device=device)
    for index, path, view in zip(images, paths, views, strict=True):
        uncovered = torch.from_numpy(_uncovered(recording, index)).to(device).float()
        picture, values = model.render(view), [uncovered]
        transmitted = uncovered * (1.0 - picture.alpha) * (picture.alpha < SKY_ALPHA)
        if has_files:
            recorded = torch.from_numpy(read_image(path, record.image_size(index)) / 255.0).to(picture.image)
            error = (picture.image.clamp(0.0, 1.0) - recorded).square().mean(dim=2)
            values.append(uncovered * error)
            of_sky += torch.stack([transmitted.sum(), (transmitted * error).sum()])
        weights = _weights(model, view, values)
        sums[: len(values)] += weights
        seen.append(weights[0] >= MIN_WEIGHT)
        sky.view(-1)[_bins_of(view.rays())[transmitted > 0.0]] = True
    centers = torch.stack([view.camera_to_world[:3, 3] for view in views])
    focal = torch.stack([view.K[0, 0] for view in views])
    errors = torch.where(sums[0] >= MIN_WEIGHT, sums[1] / sums[0], torch.nan) if has_files else None
    sky_error = float(of_sky[1] / of_sky[0].clamp(min=1e-6)) if has_files else None
    return SeenGaussians(torch.stack(seen, dim=1), centers, focal, errors), SeenSky(_grown(sky), sky_error)


@dataclass(frozen=True, eq=False)
class SeenActor:
    """From where training images saw an object: the `azimuths` (k,) of their cameras, radians to the left of its front,
    and the pixels that each had for a metre of it (k,); None: not known."""

    azimuths: Float[np.ndarray, " k"]
    pixels_per_metre: Float[np.ndarray, " k"] | None

    def side(self, actor: WorldActor, place: Float64[np.ndarray, "3"], focal: float) -> tuple[bool, float, float]:
        """What `Sides` says of an object that has these Gaussians, from a sensor at a `place` in the world with
        `focal` pixels per radian."""
        toward = inverse(actor.pose) @ np.append(place, 1.0)
        azimuth, distance = np.arctan2(toward[1], toward[0]), max(float(np.linalg.norm(toward[:3])), 1e-6)
        turns = np.abs(np.angle(np.exp(1j * (azimuth - self.azimuths))))
        known = self.pixels_per_metre
        magnifications = np.ones(len(turns)) if known is None else focal / distance / known
        similar = (turns <= SIMILAR) & (magnifications <= MAX_MAGNIFICATION)
        turn = min(float(turns.min(initial=np.pi)), OTHER_SIDE)
        return bool(similar.sum() >= MIN_IMAGES), turn, float(magnifications.min(initial=np.inf))


def seen_actors_of(record: TrainingRecord, actors: Sequence[EditedActor]) -> dict[str, SeenActor]:
    """What training images saw of the objects of a drive as recorded, by the track whose Gaussians they have. Objects
    that hide each other are not accounted for."""
    images = np.array(record.train_images)
    poses, K = record.camtoworlds[images].astype(np.float64), record.Ks[images].astype(np.float64)
    cameras = TimedCameras(
        np.array([record.seconds(i) for i in record.train_images]), poses, K, record.image_sizes[images]
    )
    return {actor.id: _seen_actor(cameras, actor) for actor in actors}


def seen_assets_of(actors: Sequence[EditedActor]) -> dict[str, SeenActor]:
    """What the drives of the inserted assets among some objects saw of them, by asset."""
    inserted = [(actor.source, actor.seen) for actor in actors if actor.seen is not None]
    return {source: SeenActor(seen[~np.isnan(seen)], None) for source, seen in inserted}


def sides_of_parts(
    model: SplatModel, known: SeenGaussians, objects: Sides, placed: PlacedModel, sets: Sequence[Gaussians],
    shown: Sequence[Tensor], place: Float[Tensor, "3"], focal: Float[Tensor, ""],
) -> Iterator[tuple[bool, Tensor, Sides]]:  # fmt: skip
    """Of each part of a placed model, of which `sets` has the Gaussians and `shown` the indices of those that count:
    whether it has objects, indices, and the sides that a sensor sees. The indices of objects are those into `objects`,
    the sides of the world's objects; of others they are the rows of `model`, the one that `known` knows.

    Raises RequestError where the placed model is none of `model`.
    """
    rows = {id(part): own for part, own in zip(model.parts, model.rows, strict=True)}
    if any(not part.has_objects and id(part) not in rows for part in placed.model.parts):
        raise RequestError("this world is not one of the drive that is known: open one drive, and take both from it")
    for part, own, chosen in zip(placed.model.parts, sets, shown, strict=True):
        if part.has_objects:
            number = torch.full_like(chosen, -1) if own.placement is None else own.placement[chosen]
            yield True, number, objects[number]
        else:
            row = chosen + rows[id(part)].start
            yield False, row, known.sides(own.means[chosen], row, place, focal)


def sides_of_objects(
    known: Mapping[str, SeenActor], actors: Sequence[WorldActor], place: Float[Tensor, "3"], focal: float
) -> Sides:
    """The sides that a sensor at a `place`, with `focal` pixels per radian, sees of these actors, and last an entry for
    what belongs to none of them: seen from here, since nothing else is known of it."""
    nothing, at, device = SeenActor(np.zeros(0), None), place.double().cpu().numpy(), place.device
    sides = [known.get(actor.source, nothing).side(actor, at, focal) for actor in actors]
    similar, turn, magnification = zip(*sides, (True, 0.0, 1.0), strict=True)
    numbers = (torch.tensor(values, dtype=torch.float32, device=device) for values in (turn, magnification))
    return Sides(torch.tensor(similar, device=device), *numbers)


def _seen_actor(cameras: TimedCameras, actor: EditedActor) -> SeenActor:
    azimuths = cameras.azimuths(actor)
    shown = ~np.isnan(azimuths)
    places = actor.poses(cameras.seconds)[shown, :3, 3]
    distances = np.linalg.norm(places - cameras.camera_to_world[shown, :3, 3], axis=1)
    return SeenActor(azimuths[shown], cameras.K[shown, 0, 0] / np.maximum(distances, 1e-6))


def _joined(sides: Sequence[Sides]) -> Sides:
    return Sides(*(torch.cat([getattr(own, field.name) for own in sides]) for field in fields(Sides)))


def _uncovered(recording: RecordedDrive, index: int) -> Bool[np.ndarray, "h w"]:
    """The pixels of a training image that show more than the vehicle's own body."""
    record = recording.record
    camera, size = recording.camera_of_name(record.camera_name(index)), record.image_size(index)
    return replace(camera, width=size[0], height=size[1]).uncovered()


def _weights(model: SplatModel, view: View, values: Sequence[Float[Tensor, "h w"]]) -> Float[Tensor, "v n"]:
    """The weights of each Gaussian in the pixels, multiplied by each of `values` and summed: the gradient of an image
    by values of Gaussians are their weights."""
    gaussians = model.gaussians_in(view)
    colors = gaussians.means.new_zeros(len(gaussians), 1).requires_grad_()
    with torch.enable_grad():
        image = model.composited(gaussians, colors, view).image[0, :, :, 0]
        sums = [(image * factor).sum() for factor in values]
        return torch.stack([torch.autograd.grad(one, colors, retain_graph=True)[0][:, 0] for one in sums])


def _bins_of(rays: Float[Tensor, "h w 3"]) -> Tensor:
    """The bins of SKY_BINS of directions, as row-major indices (h, w)."""
    elevations, azimuths = SKY_BINS
    row = (torch.asin(rays[..., 2].clamp(-1.0, 1.0)) / np.pi + 0.5) * elevations
    column = (torch.atan2(rays[..., 1], rays[..., 0]) / (2.0 * np.pi) + 0.5) * azimuths
    return row.long().clamp(0, elevations - 1) * azimuths + column.long().clamp(0, azimuths - 1)


def _grown(bins: Bool[Tensor, "e a"]) -> Bool[Tensor, "e a"]:
    """With the bins beside each; azimuths go round."""
    around = torch.nn.functional.pad(bins[None, None].float(), (1, 1, 0, 0), mode="circular")
    return torch.nn.functional.max_pool2d(around, 3, stride=1, padding=(1, 0))[0, 0] > 0.0
