"""Triangulation of matched features, and bundle adjustment of points and poses, by pycolmap and Ceres.

Three kinds of residuals: reprojection errors (pixels, Cauchy loss); deviations of poses from the given ones; deviations
of the motion between successive images from the given one. The latter two are in the ego frame: rotation vector and
translation of refined @ inverse(given), of world to ego and of ego to ego (pycolmap.cost_functions).
"""

import logging
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import pyceres
import pycolmap
from pycolmap import cost_functions

from drivesplat.preprocess.poses.readout import RollingFeatures
from drivesplat.preprocess.poses.rig import RigImages, from_pycolmap, to_pycolmap
from drivesplat.preprocess.poses.triangulated import Observations
from drivesplat.scene.rigid import inverse
from drivesplat.settings.refine_poses import PriorSettings, RefinePosesJob, RefinePosesSettings

log = logging.getLogger(__name__)

MAX_REPROJECTION_ERROR = 8.0
"""Maximum reprojection error (pixels) of a triangulated point while poses are inaccurate."""
MIN_SECONDS = 1e-3
"""Minimum interval for the motion prior, also between images of the same time."""


@dataclass(frozen=True)
class Priors:
    """Priors on poses: `given` ego_to_world (n, 4, 4) at `seconds` (n,), increasing. Residuals of poses are in units of
    `feature_noise` pixels, like those of images."""

    given: np.ndarray
    seconds: np.ndarray
    settings: PriorSettings
    feature_noise: float

    def attach(self, problem: pyceres.Problem, poses: dict[int, np.ndarray]) -> None:
        """Adds the residuals of `poses`: solver parameters of world to ego, by index into `given`."""
        given = {i: to_pycolmap(inverse(self.given[i])) for i in sorted(poses)}
        s = self.settings
        sigmas = np.array([s.tilt, s.tilt, s.heading, s.position, s.position, s.height]) / self.feature_noise
        for i, prior in given.items():
            cost = cost_functions.AbsolutePosePriorCost(np.diag(sigmas**2), prior)
            problem.add_residual_block(cost, pyceres.TrivialLoss(), [poses[i]])
        for i, j in pairwise(given):
            interval = max(MIN_SECONDS, float(self.seconds[j] - self.seconds[i]))
            covariance = np.diag((s.drift * sigmas) ** 2 * interval)
            cost = cost_functions.RelativePosePriorCost(covariance, given[i] * given[j].inverse())
            problem.add_residual_block(cost, pyceres.TrivialLoss(), [poses[i], poses[j]])


def priors_of(images: RigImages, settings: RefinePosesSettings, expected: PriorSettings | None = None) -> Priors:
    """Priors around the poses of `images`, with the `expected` errors instead of those of the settings, if given."""
    return Priors(images.ego_to_world, images.seconds, expected or settings.priors, settings.feature_noise)


def triangulate(
    reconstruction: pycolmap.Reconstruction, database: Path, job: RefinePosesJob, threads: int
) -> pycolmap.Reconstruction:
    """A copy with new points from all matches; its poses are unchanged."""
    copy = pycolmap.Reconstruction(reconstruction)
    if len(copy.images) < 2:
        return copy
    options = pycolmap.IncrementalPipelineOptions(
        random_seed=job.random_seed, num_threads=threads, extract_colors=False
    )
    options.triangulation.random_seed = job.random_seed
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = job.refine_poses.min_angle
    options.triangulation.complete_max_reproj_error = MAX_REPROJECTION_ERROR
    options.mapper.filter_max_reproj_error = MAX_REPROJECTION_ERROR
    folder = database.parent / "model"
    folder.mkdir(exist_ok=True)
    return pycolmap.triangulate_points(copy, database, database.parent, folder, True, options, False)


def adjust_in_rounds(
    start: pycolmap.Reconstruction,
    rolling: RollingFeatures,
    priors: Priors,
    database: Path,
    job: RefinePosesJob,
    threads: int,
) -> tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]:
    """Rounds of triangulation and bundle adjustment: before and after the last adjustment."""
    reconstruction = start
    rolling.move_to_timestamp(reconstruction)
    for number in range(1, job.refine_poses.rounds + 1):
        reconstruction = triangulate(reconstruction, database, job, threads)
        rolling.move_to_timestamp(reconstruction)
        unadjusted = pycolmap.Reconstruction(reconstruction)
        bundle_adjust(reconstruction, priors, job.refine_poses.robust_pixels, threads)
        log.info(
            "round %d of %d: %d points adjusted with %d images",
            number, job.refine_poses.rounds, len(reconstruction.points3D), len(reconstruction.images),
        )  # fmt: skip
    return unadjusted, reconstruction


def bundle_adjust(
    reconstruction: pycolmap.Reconstruction,
    priors: Priors | None,
    robust_pixels: float,
    threads: int,
    lens: Literal["fixed", "radial", "free"] = "fixed",
) -> None:
    """Optimises points and poses in place; without `priors` only points. Images without points keep their poses. With
    `lens`, also the radial coefficients of cameras with one, or these, focal lengths and principal points."""
    config = pycolmap.BundleAdjustmentConfig()
    # Only these have residuals of their own, and only their rotations get the manifold of rotations in the solver.
    constrained = sorted(number for number, image in reconstruction.images.items() if image.num_points3D)
    for number in constrained:
        config.add_image(number)
        if priors is None:
            config.set_constant_rig_from_world_pose(number)
    if lens == "fixed":
        for camera in reconstruction.cameras:
            config.set_constant_cam_intrinsics(camera)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_sensor_from_rig=False)
    options.refine_focal_length = options.refine_principal_point = lens == "free"
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = robust_pixels
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.function_tolerance = 1e-6
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    problem = adjuster.problem  # owns the residuals of the priors: must outlive solve()
    if priors is not None:
        frames = reconstruction.frames
        priors.attach(problem, {number - 1: frames[number].rig_from_world.params for number in constrained})
    adjuster.solve()
    del problem


def with_poses(reconstruction: pycolmap.Reconstruction, ego_to_world: np.ndarray) -> pycolmap.Reconstruction:
    """A copy with the poses `ego_to_world` (n, 4, 4), in the order of image numbers."""
    copy = pycolmap.Reconstruction(reconstruction)
    for number, pose in zip(sorted(copy.frames), ego_to_world, strict=True):
        copy.frames[number].rig_from_world = to_pycolmap(inverse(pose))
    return copy


def poses_of(reconstruction: pycolmap.Reconstruction) -> np.ndarray:
    """ego_to_world (n, 4, 4) of all images, in the order of their numbers."""
    frames = (reconstruction.frames[number] for number in sorted(reconstruction.frames))
    return np.stack([inverse(from_pycolmap(frame.rig_from_world)) for frame in frames])


def observations_of(reconstruction: pycolmap.Reconstruction) -> Observations:
    numbers = sorted(reconstruction.points3D)
    index = {number: i for i, number in enumerate(numbers)}
    rows: list[tuple[int, int, float]] = []
    for i, number in enumerate(sorted(reconstruction.images)):
        image = reconstruction.images[number]
        for feature in image.get_observation_points2D():
            pixel = image.project_point(reconstruction.points3D[feature.point3D_id].xyz)
            error = np.inf if pixel is None else float(np.linalg.norm(pixel - feature.xy))
            rows.append((i, index[feature.point3D_id], error))
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    positions = np.array([reconstruction.points3D[number].xyz for number in numbers]).reshape(-1, 3)
    image_index, point_index = table[:, :2].astype(np.int64).T
    return Observations(image_index, point_index, table[:, 2], positions, np.array(numbers, dtype=np.int64))
