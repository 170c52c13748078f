"""Whether the images of a camera agree with its intrinsics: a trial adjustment with a free lens.

Points and poses of some images are adjusted three times: with the lens as stated; with a radial coefficient; with a
radial coefficient, a focal length and a principal point. Each half of the points judges the lens that was adjusted to
the other half. A lens counts as wrong only where both halves say so and points that were not adjusted fit the other
lens better: images of a vehicle that drives straight ahead, for example, do not determine a focal length.
"""

import dataclasses
import logging
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap

from drivesplat.preprocess.poses.adjustment import (
    Priors,
    adjust_in_rounds,
    bundle_adjust,
    observations_of,
    poses_of,
    priors_of,
    with_poses,
)
from drivesplat.preprocess.poses.features import detect_features, match_features
from drivesplat.preprocess.poses.readout import RollingFeatures
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.scene import UNPOSED, Frame, Scene
from drivesplat.settings.refine_poses import FeatureSettings, RefinePosesJob, RefinePosesSettings

log = logging.getLogger(__name__)

FEATURES = FeatureSettings(max_image_size=640, max_features=1000, neighbours=4)
MAX_IMAGES = (20, 48)
"""Images of one camera, and of all cameras, that a trial reads."""
MIN_IMAGES, MIN_POINTS = 8, 200
"""Minimum numbers of images and of triangulated points for a trial."""
MIN_STEP, MIN_TURN = 1.0, 3.0
"""Metres, or degrees, between the poses of successive images of a trial."""
MIN_DISTORTION = 0.025
"""Change of the radius of a corner, relative to the radius, from which a distortion is reported. Rectified images of
recorded drives show up to 0.014."""
MIN_FOCAL_CHANGE, MIN_CENTRE_CHANGE = 0.1, 0.1
"""Relative change of the focal length, and change of the principal point relative to the size of the image, from which
a camera matrix is reported."""
MIN_SIGNIFICANCE = 2.0
"""Minimum mean decrease of the loss of withheld points, in standard errors."""
MAX_ERROR = 4.0
"""Error in pixels from which the loss of an observation is constant: no single point decides."""

Kind = Literal["fixed", "radial", "free"]


@dataclass(frozen=True)
class Lens:
    """A pinhole camera with one radial coefficient: radius f (r + k1 r³) at the tangent r."""

    focal: float
    centre: tuple[float, float]
    k1: float


@dataclass(frozen=True)
class LensTrial:
    """The trial of one camera. `stated`: its lens, with `width` and `height` in pixels. By kind of adjustment:
    `lenses`, adjusted to each half of the points, and the `losses` (p,) and median `errors` (pixels) of all p points,
    each with the lens of the half that it does not belong to."""

    camera: str
    width: int
    height: int
    stated: Lens
    lenses: dict[Kind, tuple[Lens, Lens]]
    losses: dict[Kind, np.ndarray]
    errors: dict[Kind, float]

    def significance(self, better: Kind, worse: Kind) -> float:
        """Mean decrease of the loss of a point, in standard errors."""
        gain = self.losses[worse] - self.losses[better]
        return float(gain.mean() / max(gain.std() / np.sqrt(len(gain)), 1e-12))

    def warning(self) -> str | None:
        """A sentence where images contradict the stated lens: its camera matrix, or else its distortion."""

        def better(kind: Kind) -> str:
            return (
                f"points that were not adjusted fit better (median error {self.errors[kind]:.3f} instead of "
                f"{self.errors['fixed']:.3f} pixels)"
            )

        old, new = self.stated, self.lenses["free"]
        changes = [
            [lens.focal / old.focal - 1.0 for lens in new],
            [(lens.centre[0] - old.centre[0]) / self.width for lens in new],
            [(lens.centre[1] - old.centre[1]) / self.height for lens in new],
        ]
        limits = (MIN_FOCAL_CHANGE, MIN_CENTRE_CHANGE, MIN_CENTRE_CHANGE)
        significance = min(self.significance("free", "fixed"), self.significance("free", "radial"))
        beyond = (_both_beyond(pair, limit) for pair, limit in zip(changes, limits, strict=True))
        if any(beyond) and not significance < MIN_SIGNIFICANCE:
            focal, x, y = (np.mean(each) for each in zip(*((lens.focal, *lens.centre) for lens in new), strict=True))
            return (
                f"images of camera {self.camera} contradict its camera matrix K: {better('free')} with a focal length "
                f"of {focal:.0f} pixels instead of {old.focal:.0f} and the principal point ({x:.0f}, {y:.0f}) instead "
                f"of ({old.centre[0]:.0f}, {old.centre[1]:.0f}); K may belong to another image size"
            )
        corner = np.hypot(self.width, self.height) / 2.0
        pair = [lens.k1 * (corner / lens.focal) ** 2 for lens in self.lenses["radial"]]
        if not _both_beyond(pair, MIN_DISTORTION) or self.significance("radial", "fixed") < MIN_SIGNIFICANCE:
            return None
        k1 = float(np.mean([lens.k1 for lens in self.lenses["radial"]]))
        return (
            f"images of camera {self.camera} look distorted: {better('radial')} with k1 = {k1:.2g} "
            f"({abs(np.mean(pair)) * corner:.0f} pixels at the corner); state the distortion of the lens, or correct "
            "the stated one"
        )


def lens_warnings(scene: Scene, ego_mask: EgoMask = NO_EGO_MASK, threads: int = 1) -> list[str]:
    """Sentences about cameras whose images contradict their intrinsics. `scene`: of `with_tested_images`, without
    distortion. Features on the ego vehicle and on boxes that move are ignored. Of a camera with too few images or
    points nothing is said.

    Raises DatasetError where an image cannot be read, or where a camera moves on the vehicle.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR
    job = RefinePosesJob(refine_poses=RefinePosesSettings(features=FEATURES, rounds=2), random_seed=0)
    found = []
    for camera in dict.fromkeys(frame.camera for frame in scene.frames):
        of_camera = [i for i, frame in enumerate(scene.frames) if frame.camera == camera]
        images = RigImages.of(scene, of_camera, ego_mask)
        log.info("camera %s: its lens is tried on %d images", camera, len(images))
        with tempfile.TemporaryDirectory(prefix="drivesplat-lens-") as folder:
            database = Path(folder) / "features.db"
            start = detect_features(images, job, database, threads)
            match_features(images, job, database, threads)
            trial = lens_trial(images, start, database, job, threads)
        found.append(trial.warning() if trial else None)
    return [sentence for sentence in found if sentence]


def with_tested_images(scene: Scene) -> Scene:
    """The scene with the images that a trial reads, at most MAX_IMAGES, as successive key frames of their cameras: key
    frames from different places. Without those of a camera that has too few, and without poses none."""
    by_camera: dict[str, list[Frame]] = {}
    for frame in sorted(scene.frames, key=lambda frame: frame.timestamp):
        if frame.is_key_frame and scene.poses != UNPOSED:
            by_camera.setdefault(frame.camera, []).append(frame)
    number = max(MIN_IMAGES, min(MAX_IMAGES[0], MAX_IMAGES[1] // max(1, len(by_camera))))
    chosen = []
    for frames in by_camera.values():
        apart = frames[:1]
        for frame in frames[1:]:
            last = apart[-1].ego_to_world
            moved = np.linalg.norm(frame.ego_to_world[:3, 3] - last[:3, 3])
            if moved > MIN_STEP or _turn(last, frame.ego_to_world) > MIN_TURN:
                apart.append(frame)
        # the window in which the vehicle turns most: turns determine a focal length
        turns = np.array([_turn(a.ego_to_world, b.ego_to_world) for a, b in pairwise(apart)])
        sums = [turns[i : i + number - 1].sum() for i in range(max(1, len(apart) - number + 1))]
        first = int(np.argmax(np.round(sums, 3)))
        chosen.append(apart[first : first + number])
    usable = [frames for frames in chosen if len(frames) >= MIN_IMAGES][: MAX_IMAGES[1] // number]
    tested = [dataclasses.replace(frame, sample_index=i) for frames in usable for i, frame in enumerate(frames)]
    return dataclasses.replace(scene, frames=tuple(tested))


def _turn(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between two poses (4, 4)."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))))


def lens_trial(
    images: RigImages, start: pycolmap.Reconstruction, database: Path, job: RefinePosesJob, threads: int = 1
) -> LensTrial | None:
    """The trial of images of one camera, with features in `start` and matches in `database`. None where they have too
    few points."""
    priors = priors_of(images, job.refine_poses)
    unadjusted, _ = adjust_in_rounds(start, RollingFeatures.of(images, start), priors, database, job, threads)
    numbers = np.array(sorted(unadjusted.points3D), dtype=np.int64)
    if len(numbers) < MIN_POINTS:
        return None
    # A copy whose camera has one focal length and a radial coefficient; rows of features are scaled accordingly.
    model = pycolmap.Reconstruction(unadjusted)
    camera = model.cameras[1]
    focal, vertical, x, y = camera.params
    for image in model.images.values():
        for feature in image.points2D:
            feature.xy = feature.xy * [1.0, focal / vertical]
    camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
    camera.params = [focal, x, y * focal / vertical, 0.0]
    halves = np.array_split(np.random.default_rng(job.random_seed).permutation(numbers), 2)
    lenses: dict[Kind, tuple[Lens, Lens]] = {}
    losses: dict[Kind, np.ndarray] = {}
    errors: dict[Kind, float] = {}
    for kind in ("fixed", "radial", "free"):
        tried = [
            _judged(model, adjusted, judging, kind, priors, threads) for adjusted, judging in (halves, halves[::-1])
        ]
        lenses[kind] = (tried[0][0], tried[1][0])
        losses[kind] = np.concatenate([loss for _, loss, _ in tried])
        errors[kind] = float(np.median(np.concatenate([error for _, _, error in tried])))
    return LensTrial(images.cameras[0], camera.width, camera.height, _lens(camera), lenses, losses, errors)


def _lens(camera: pycolmap.Camera) -> Lens:
    focal, x, y, k1 = camera.params
    return Lens(float(focal), (float(x), float(y)), float(k1))


def _judged(
    model: pycolmap.Reconstruction, adjusted: np.ndarray, judging: np.ndarray, kind: Kind, priors: Priors, threads: int
) -> tuple[Lens, np.ndarray, np.ndarray]:
    """The lens adjusted to the points with the numbers `adjusted`. Of the points `judging` (p,), fitted to this lens
    and its poses: the sums (p,) of the losses of their observations, and the errors (o,) of all observations."""
    reduced, fitted = pycolmap.Reconstruction(model), pycolmap.Reconstruction(model)
    for number in judging.tolist():
        reduced.delete_point3D(number)
    bundle_adjust(reduced, priors, 1.0, threads, kind)
    for number in adjusted.tolist():
        fitted.delete_point3D(number)
    fitted = with_poses(fitted, poses_of(reduced))
    fitted.cameras[1].params = reduced.cameras[1].params
    bundle_adjust(fitted, None, 1.0, threads)
    seen = observations_of(fitted)
    points = np.searchsorted(np.sort(judging), seen.numbers[seen.point])
    loss = np.bincount(points, np.log1p(np.minimum(seen.error, MAX_ERROR) ** 2), minlength=len(judging))
    return _lens(reduced.cameras[1]), loss, np.minimum(seen.error, MAX_ERROR)


def _both_beyond(pair: list[float], limit: float) -> bool:
    """Whether both values exceed a limit in the same direction."""
    return bool(min(pair) > limit or max(pair) < -limit)
