"""How far an image from off the recorded path can be trusted: the PSNR that it would have beside a true image, and a
validity from 0 to 1.

The squared error of a pixel is expected to be that of training images where they show the same Gaussians, more where
these are seen from another direction or from nearer than any training image saw them, and UNSEEN_ERROR where a pixel
shows what none saw:

    error = e (1 + ASIDE aside) (1 + a (sqrt(turn / 10 degrees) + NEARER (magnification - 1)))

e is the error of a Gaussian in training images, `aside` the distance of the camera from the recorded path in metres;
`turn` and `magnification` are those of `Sides`. `a`, how fast a drive gets worse between its training images, is fitted
to the PSNR of its own held-out images, which eval.json states. The other constants were fitted to the drive of the demo
(docs/closed_loop.md).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.drive.world_state import WorldState
from drivesplat.errors import RequestError
from drivesplat.model.gaussians import concatenate_shapes
from drivesplat.model.view import View, view_of
from drivesplat.simulate.held_out import GROUPS, GROWTHS, held_out_figures, read_metrics
from drivesplat.simulate.seen_from import (
    SeenActor,
    SeenGaussians,
    SeenSky,
    Sides,
    TrainingCameras,
    may_show,
    reduced,
    seen_actors_of,
    seen_assets_of,
    seen_by_training,
    sides_of_objects,
    sides_of_parts,
    training_images,
)

MAX_SIDE = 100
"""Pixels along the longer side of the image in which the validity is computed."""

UNSEEN_ERROR = 0.025
"""Squared error of a pixel that shows what no training image saw (PSNR: 16 dB)."""
NEARER = 0.25
"""Weight of the magnification, which counts up to MAX_NEARER."""
MAX_NEARER = 4.0
ASIDE = 0.1
"""Growth of errors with each metre beside the recorded path."""
DEFAULT_GROWTH, LEVELS = 1.0, (1e-3, 1e3)
"""`a` where held-out images do not tell, and the limits of the factor of DEFAULT_ERROR."""
DEFAULT_ERROR = 10.0**-2.6
"""Squared error of training images whose files are missing (PSNR: 26 dB), before it is fitted to held-out images."""
RESIDUALS = (-3.8, 1.6)
"""True minus expected PSNR (dB): nine of ten views of three other streets are above the lower one, with the method
`street`; the upper one is the 95 % quantile of the demo's street, times 1.5."""
HALVING_DB = 6.0
"""Drop of the PSNR that halves the validity."""
MIN_ERROR = 1e-6
"""The least expected squared error of an image."""


@dataclass(frozen=True)
class ViewValidity:
    """How far an image can be trusted.

    `distance` (metres) is that to the nearest training camera, `angle` (degrees) that between the optical axes of the
    image and of training cameras there, `aside` (metres) the distance to the recorded path of the cameras. `supported`,
    `unseen` and `turned` are shares of the image's pixels. `supported`: Gaussians that two
    training images saw from within 20 degrees and at half the scale or more, and sky that they saw. `unseen`: static
    Gaussians that no training image saw, or none from within 40 degrees, among them those that fill gaps of the road;
    and directions without Gaussians in which no training image saw the sky. `turned`: objects that show a side that no
    training image saw, which is farther round than 40 degrees. What is neither is seen from a somewhat other direction.

    `expected_psnr` (dB) is that of the whole image beside a true one, and `interval` (dB) where 90 % of views of the
    calibration lie about it; None where the drive has neither training images nor metrics to tell. `drop` (dB) is how
    much worse the image is expected to be than held-out images on the path; below 0 for better ones.

    `validity` is 0.5^(drop / 6 dB), at most 1, multiplied by the share of the pixels that show what training images
    saw, without those of the sky: 1 is as good as held-out images, 0 shows nothing that was ever seen.
    """

    distance: float
    angle: float
    aside: float
    supported: float
    unseen: float
    turned: float
    expected_psnr: float | None
    interval: tuple[float, float] | None
    drop: float
    validity: float


@dataclass(frozen=True)
class _Means:
    """Means over the pixels of an image: the shares of `ViewValidity`, the share of the known `sky`, and the expected
    squared error (`error`)."""

    supported: float
    unseen: float
    turned: float
    sky: float
    error: float

    @property
    def known(self) -> float:
        """The share of the pixels other than known sky that show what training images saw."""
        return 1.0 - min(1.0, (self.unseen + self.turned) / max(1.0 - self.sky, 1e-6))


@dataclass(frozen=True, eq=False)
class TrainingErrors:
    """Squared errors of colours in [0, 1] in training images: of the `gaussians` (n,), the rows of all parts, of
    `objects` by their tracks, of `others` and of the `sky`. `growth` is `a`. Unless `are_measured` they are a guess."""

    gaussians: Float[Tensor, " n"]
    objects: dict[str, float]
    others: float
    sky: float
    growth: float
    are_measured: bool

    @classmethod
    def of(cls, drive: TrainedDrive, seen: SeenGaussians, sky: SeenSky) -> "TrainingErrors":
        """Those that were measured; DEFAULT_ERROR without recorded images, and the mean for what none of them shows."""
        if seen.errors is None or sky.error is None or bool(seen.errors.isnan().all()):
            return cls(torch.full_like(seen.seen[:, 0], DEFAULT_ERROR, dtype=torch.float32), {}, DEFAULT_ERROR,
                       DEFAULT_ERROR, DEFAULT_GROWTH, False)  # fmt: skip
        mean = float(seen.errors.nanmean())
        of_objects = {track: seen.errors[drive.model.of_track(track)].nanmean() for track in _tracks(drive)}
        objects = {track: float(error) for track, error in of_objects.items() if not error.isnan()}
        return cls(seen.errors.nan_to_num(mean), objects, mean, sky.error, DEFAULT_GROWTH, True)

    def scaled(self, factor: float) -> "TrainingErrors":
        """All of them multiplied by a factor."""
        objects = {track: factor * error for track, error in self.objects.items()}
        return replace(self, gaussians=factor * self.gaussians, objects=objects, others=factor * self.others,
                       sky=factor * self.sky)  # fmt: skip

    def expected(self, sides: Sides, errors: Float[Tensor, " k"], aside: float) -> Float[Tensor, " k"]:
        """Those in an image, from `aside` metres beside the recorded path, that shows these sides, of the errors in
        training images."""
        change = torch.sqrt(torch.rad2deg(sides.turn) / 10.0) + NEARER * (
            sides.magnification.clamp(1.0, MAX_NEARER) - 1.0
        )
        return torch.where(sides.unseen, UNSEEN_ERROR, (1.0 + ASIDE * aside) * errors * (1.0 + self.growth * change))


@dataclass(frozen=True, eq=False)
class ViewKnowledge:
    """What the training images of a `drive` tell of images from other places: what they saw of its `gaussians`, `sky`
    and `objects` with which `errors`, and their `cameras`. `reference` is the expected squared error of held-out
    images on the path. Unless `is_absolute`, errors are known but for a factor."""

    drive: TrainedDrive
    gaussians: SeenGaussians
    sky: SeenSky
    objects: dict[str, SeenActor]
    errors: TrainingErrors
    cameras: TrainingCameras
    reference: float = DEFAULT_ERROR
    is_absolute: bool = True

    @classmethod
    def of_drive(cls, drive: TrainedDrive) -> "ViewKnowledge":
        """Renders all training images once, and compares them with the recorded ones where their files exist: without,
        all Gaussians have the same error. Then it fits the errors to the held-out images of eval.json beside the model;
        without this file DEFAULT_GROWTH holds. Where no image is held out, training images are the reference.

        Raises RequestError for a drive without training images, ResultError for an invalid eval.json.

        >>> drive = drivesplat.open("results/demo/street")
        >>> known, world = ViewKnowledge.of_drive(drive), drive.state(4.2)
        >>> known.validity(world, drive.view("CAM_FRONT", 4.2)).validity
        """
        images = training_images(drive.record)
        if not images:
            raise RequestError(
                f"{drive.where} has no training images, so that nothing tells how far others can be trusted: train it "
                "with cameras"
            )
        gaussians, sky = seen_by_training(drive.recording, drive.folder, drive.model, drive.device, images)
        errors = TrainingErrors.of(drive, gaussians, sky)
        recorded = drive if drive.before is None else drive.before
        objects = seen_actors_of(drive.record, recorded.edited_actors) | seen_assets_of(drive.edited_actors)
        known = cls(drive, gaussians, sky, objects, errors, TrainingCameras.of(drive.record, drive.device))
        held_out = held_out_images(drive)
        fitted = known._fitted_to(held_out) if held_out else replace(known, is_absolute=errors.are_measured)
        near = next((group.images for group in held_out if group.name == GROUPS[0]), None)
        least = near or [index for group in held_out for index in group.images] or images
        logs = [math.log(fitted._means_of_image(index).error) for index in least]
        return replace(fitted, reference=math.exp(sum(logs) / len(logs)))

    @torch.no_grad()
    def validity(self, world: WorldState, view: View) -> ViewValidity:
        """How far the image of a view of this drive can be trusted, at the time of `world` and with its objects.

        Raises RequestError for a world of another drive.
        """
        means = self._means(world, view)
        distance, angle = self.cameras.distance_and_angle(view)
        drop, psnr = 10.0 * math.log10(means.error / self.reference), -10.0 * math.log10(means.error)
        return ViewValidity(
            distance=distance,
            angle=angle,
            aside=self.cameras.aside(view),
            supported=means.supported,
            unseen=means.unseen,
            turned=means.turned,
            expected_psnr=psnr if self.is_absolute else None,
            interval=(psnr + RESIDUALS[0], psnr + RESIDUALS[1]) if self.is_absolute else None,
            drop=drop,
            validity=means.known * min(1.0, 0.5 ** (drop / HALVING_DB)),
        )

    def _means(self, world: WorldState, view: View) -> _Means:
        """The means over the pixels of an image of low resolution, of four values of Gaussians: whether they are
        supported, unseen sides of static ones and of objects, and expected errors. Four, since kernels are compiled for
        a number of values."""
        small, placed = reduced(view, MAX_SIDE), world.placed()
        aside = self.cameras.aside(view)
        sets, actors = placed.sets_in(small), list(world.actors.values())
        place, focal = view.camera_to_world[:3, 3], view.K[0, 0]
        of_objects = sides_of_objects(self.objects, actors, place, float(focal))
        of_sources = [self.errors.objects.get(actor.source, self.errors.others) for actor in actors]
        errors = torch.tensor([*of_sources, self.errors.others], device=view.K.device)
        shapes, values, kept, first = concatenate_shapes(sets), [], [], 0
        shown = [may_show(view, own) for own in sets]
        parts = sides_of_parts(self.drive.model, self.gaussians, of_objects, placed, sets, shown, place, focal)
        for own, chosen, (has_objects, index, sides) in zip(sets, shown, parts, strict=True):
            before = (errors if has_objects else self.errors.gaussians)[index]
            unseen, nothing = sides.unseen.float(), torch.zeros_like(before)
            of_kind = (nothing, unseen) if has_objects else (unseen, nothing)
            supported = (sides.similar & ~sides.unseen).float()
            values.append(torch.stack([supported, *of_kind, self.errors.expected(sides, before, aside)], dim=1))
            kept.append(chosen + first)
            first += len(own)
        found = placed.model.composited(shapes[torch.cat(kept)], torch.cat(values), small)
        through, known = 1.0 - found.alpha[0, :, :, 0], self.sky.known(small)
        of_sky = torch.stack([(through * known).mean(), (through * (1.0 - known)).mean()])
        supported, unseen, turned, error, sky, unknown = [*found.image[0].mean(dim=(0, 1)).tolist(), *of_sky.tolist()]
        error += self.errors.sky * sky + UNSEEN_ERROR * unknown
        return _Means(supported + sky, unseen + unknown, turned, sky, max(error, MIN_ERROR))

    @torch.no_grad()
    def _means_of_image(self, index: int) -> _Means:
        """The means of a recorded image of the drive as recorded."""
        drive = self.drive if self.drive.before is None else self.drive.before
        view = view_of(self.drive.record, index, self.drive.device)
        return self._means(drive.state(view.time, outside="clamp"), view)

    def _fitted_to(self, held_out: Sequence["HeldOut"]) -> "ViewKnowledge":
        """With the growth of errors by which the mean PSNR of held-out images is as it was measured; and with the level
        of errors, where none within limits does that or where they are a guess."""
        images = [index for group in held_out for index in group.images]
        measured = sum(group.psnr * len(group.images) for group in held_out) / len(images)

        def solved(at: Callable[[float], TrainingErrors], limits: tuple[float, float]) -> TrainingErrors:
            """The errors `at` the number within limits by which that holds. Those of images are linear in it."""
            known = [replace(self, errors=at(number)) for number in (1.0, 2.0)]
            once, twice = ([one._means_of_image(index).error for index in images] for one in known)
            return at(_solved(once, twice, measured, limits))

        errors = self.errors
        if errors.are_measured:
            errors = solved(lambda growth: replace(self.errors, growth=growth), GROWTHS)
        return replace(self, errors=solved(errors.scaled, LEVELS))


@dataclass(frozen=True)
class HeldOut:
    """A group of held-out images: its `name`, the indices of its `images`, and the mean of their PSNR (dB)."""

    name: str
    images: list[int]
    psnr: float


def held_out_images(drive: TrainedDrive) -> list[HeldOut]:
    """The groups of held-out images in eval.json beside the model; none without this file. Raises ResultError for an
    invalid one."""
    record, found = drive.record, []
    camera = read_metrics(drive.folder, lambda content: content["protocol"]["eval_camera"])
    for name, psnr in held_out_figures(drive.folder, "all", "psnr_frame_mean").items():
        own = (int(index) for index in record.splits.get(name, ()))
        images = [index for index in own if record.is_key_frame[index] and record.camera_name(index) == camera]
        if images:
            found.append(HeldOut(name, images, psnr))
    return found


def _tracks(drive: TrainedDrive) -> list[str]:
    recorded = drive if drive.before is None else drive.before
    return [actor.id for actor in recorded.edited_actors if drive.model.of_track(actor.id) is not None]


def _solved(once: Sequence[float], twice: Sequence[float], psnr: float, limits: tuple[float, float]) -> float:
    """The number within limits by which the mean PSNR of images is `psnr`: their errors are linear in it, `once` at 1
    and `twice` at 2."""
    low, high = limits
    for _ in range(60):
        number = math.sqrt(low * high)
        errors = [max(one + (number - 1.0) * (two - one), MIN_ERROR) for one, two in zip(once, twice, strict=True)]
        mean = -10.0 * sum(math.log10(error) for error in errors) / len(errors)
        low, high = (number, high) if mean > psnr else (low, number)
    return number
