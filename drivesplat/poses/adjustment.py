"""Points from matched features and given poses, and both adjusted to what the images show.

Bundle adjustment by pycolmap and Ceres, with three kinds of residuals: reprojection errors (pixels, Cauchy's loss); how
far poses are from the given ones; and how far motions from one image to the next are from the given ones. The latter
two are in the own car's frame, where a prior knows which way is up: rotation vector and translation of refined @
inverse(given), of world to ego and of ego to ego (pycolmap.cost_functions).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyceres
import pycolmap
from pycolmap import cost_functions

from drivesplat.poses.observations import Observations
from drivesplat.poses.rig import RigImages, to_pycolmap
from drivesplat.scene.rigid import inverse
from drivesplat.settings.refine_poses import PriorSettings, RefinePosesJob, RefinePosesSettings

WORST_PIXELS = 8.0
"""Reprojection errors up to this make a point while poses are still off."""
MIN_SECONDS = 1e-3
"""Images that are taken at the same time are joined as if this lay between them."""


@dataclass(frozen=True)
class Priors:
    """What is known of the poses beforehand: `given` ego_to_world (n, 4, 4) at `seconds` (n,), increasing. Residuals of
    images are in pixels, so those of poses are in units of `feature_noise` pixels."""

    given: np.ndarray
    seconds: np.ndarray
    settings: PriorSettings
    feature_noise: float

    def attach(self, problem: pyceres.Problem, poses: dict[int, np.ndarray]) -> None:
        """Adds its residuals on `poses`, the parameters of world to ego by the images' positions among the given."""
        given = {i: to_pycolmap(inverse(self.given[i])) for i in sorted(poses)}
        deviations = self._deviations()
        covariance = np.diag(deviations**2)
        for i, prior in given.items():
            cost = cost_functions.AbsolutePosePriorCost(covariance, prior)
            problem.add_residual_block(cost, pyceres.TrivialLoss(), [poses[i]])
        for i, j in pairwise(given):
            passed = max(MIN_SECONDS, float(self.seconds[j] - self.seconds[i]))
            covariance = np.diag((self.settings.drift * deviations) ** 2 * passed)
            cost = cost_functions.RelativePosePriorCost(covariance, given[i] * given[j].inverse())
            problem.add_residual_block(cost, pyceres.TrivialLoss(), [poses[i], poses[j]])

    def _deviations(self) -> np.ndarray:
        """Standard deviations (6,) of rotation and translation about and along the car's axes, as the solver takes
        them."""
        s = self.settings
        return np.array([s.tilt, s.tilt, s.heading, s.position, s.position, s.height]) / self.feature_noise


def priors_of(images: RigImages, settings: RefinePosesSettings) -> Priors:
    given = np.stack([frame.ego_to_world for frame in images.frames])
    return Priors(given, images.seconds, settings.priors, settings.feature_noise)


def triangulated(
    reconstruction: pycolmap.Reconstruction, database: Path, job: RefinePosesJob, threads: int
) -> pycolmap.Reconstruction:
    """A copy with points made anew from all matches, its poses as they are."""
    copy = pycolmap.Reconstruction(reconstruction)
    if len(copy.images) < 2:
        return copy
    options = pycolmap.IncrementalPipelineOptions(
        random_seed=job.random_seed, num_threads=threads, extract_colors=False
    )
    options.triangulation.random_seed = job.random_seed
    options.triangulation.min_angle = job.refine_poses.min_angle
    options.triangulation.complete_max_reproj_error = WORST_PIXELS
    options.mapper.filter_min_tri_angle = job.refine_poses.min_angle
    options.mapper.filter_max_reproj_error = WORST_PIXELS
    folder = database.parent / "model"
    folder.mkdir(exist_ok=True)
    return pycolmap.triangulate_points(copy, database, database.parent, folder, True, options, False)


def adjust(reconstruction: pycolmap.Reconstruction, priors: Priors | None, robust_pixels: float, threads: int) -> None:
    """Moves points and poses in place to where residuals are least; without `priors` the points alone. Images that see
    no points stay where they are."""
    config = pycolmap.BundleAdjustmentConfig()
    for number in _with_points(reconstruction):
        config.add_image(number)
    for camera in reconstruction.cameras:
        config.set_constant_cam_intrinsics(camera)
    if priors is None:
        for moment in _with_points(reconstruction):
            config.set_constant_rig_from_world_pose(moment)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_sensor_from_rig=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = robust_pixels
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.function_tolerance = 1e-6
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    problem = adjuster.problem  # owns what is attached to it: it has to outlive the solver's work
    if priors is not None:
        moments = {number - 1: reconstruction.frames[number] for number in _with_points(reconstruction)}
        priors.attach(problem, {i: moment.rig_from_world.params for i, moment in moments.items()})
    adjuster.solve()
    del problem


def _with_points(reconstruction: pycolmap.Reconstruction) -> list[int]:
    """The numbers of images (and of their moments) that see points: only these have residuals of their own, and only
    their poses' rotations are known as rotations to the solver."""
    return sorted(number for number, image in reconstruction.images.items() if image.num_points3D)


def with_poses_of(reconstruction: pycolmap.Reconstruction, ego_to_world: np.ndarray) -> pycolmap.Reconstruction:
    """A copy with the poses `ego_to_world` (n, 4, 4), in the order of its images' numbers."""
    copy = pycolmap.Reconstruction(reconstruction)
    for number, pose in zip(sorted(copy.frames), ego_to_world, strict=True):
        copy.frames[number].rig_from_world = to_pycolmap(inverse(pose))
    return copy


def without_points(reconstruction: pycolmap.Reconstruction, points: Iterable[int]) -> pycolmap.Reconstruction:
    """A copy without the points of these numbers."""
    copy = pycolmap.Reconstruction(reconstruction)
    for point in points:
        copy.delete_point3D(point)
    return copy


def observations(reconstruction: pycolmap.Reconstruction) -> Observations:
    """All observations of a reconstruction."""
    numbers = sorted(reconstruction.points3D)
    position = {number: i for i, number in enumerate(numbers)}
    rows: list[tuple[int, int, float]] = []
    for i, number in enumerate(sorted(reconstruction.images)):
        image = reconstruction.images[number]
        for seen in image.points2D:
            if seen.has_point3D():
                pixel = image.project_point(reconstruction.points3D[seen.point3D_id].xyz)
                error = np.inf if pixel is None else float(np.linalg.norm(pixel - seen.xy))
                rows.append((i, position[seen.point3D_id], error))
    image, point, error = zip(*rows, strict=True) if rows else ((), (), ())
    positions = np.array([reconstruction.points3D[number].xyz for number in numbers]).reshape(-1, 3)
    return Observations(
        np.array(image, dtype=np.int64),
        np.array(point, dtype=np.int64),
        np.array(error, dtype=np.float64),
        positions,
        np.array(numbers, dtype=np.int64),
    )
