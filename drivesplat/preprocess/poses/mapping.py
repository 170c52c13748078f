"""Camera poses from images alone: pycolmap's incremental mapper on the features and matches of a scene.

Each camera is mapped separately, and the one with the largest model places the vehicle; the others have fixed mounts. A
joint model would depend on the few points that two cameras share. Intrinsics are fixed. The model has an arbitrary
scale, so only camera poses are taken from it, never ego poses: mounts are metric.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from drivesplat.errors import DatasetError
from drivesplat.preprocess.poses.features import image_name
from drivesplat.preprocess.poses.rig import RigImages, from_pycolmap
from drivesplat.scene.rigid import inverse
from drivesplat.settings.refine_poses import RefinePosesJob

log = logging.getLogger(__name__)

REMEDY = "such a drive needs recorded poses (refine_poses.start: recorded)"
"""The end of every message about a failure of poses from images."""
MIN_ANGLE = 1.5
"""Minimum angle (degrees) between the rays of a point; smaller ones distort poses that are not yet known."""
INITIAL_ANGLE = 6.0
"""Preferred angle (degrees) between the rays of the first two images. pycolmap accepts a quarter of it."""
MIN_MODEL_IMAGES = 3
LOG_INTERVAL_S = 10.0
"""Minimum seconds between two lines of progress in the log."""


@dataclass(frozen=True)
class ImagePoints:
    """Triangulated points in an image: `pixels` (m, 2), continuous, and `depth` (m,) along the optical axis in units of
    the model."""

    pixels: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class MappedImages:
    """The n images of one `camera` in a model: `placed` (n,), increasing indices into RigImages; `camera_to_model` (n,
    4, 4); `points` per image. `sizes`: number of images of each of the camera's models, this one first."""

    camera: str
    placed: np.ndarray
    camera_to_model: np.ndarray
    points: tuple[ImagePoints, ...]
    sizes: tuple[int, ...]

    def without(self, outliers: np.ndarray) -> "MappedImages":
        """The same without the images marked in `outliers` (n,) bool."""
        kept = np.flatnonzero(~outliers)
        points = tuple(self.points[i] for i in kept)
        return replace(self, placed=self.placed[kept], camera_to_model=self.camera_to_model[kept], points=points)


def map_images(images: RigImages, database: Path, job: RefinePosesJob, threads: int) -> MappedImages:
    """The largest model of one camera's images, from the features and matches in `database`.

    Raises DatasetError where there is none, or where it has too few images.
    """
    models = {camera: _models(images, camera, database, job, threads) for camera in images.cameras}
    camera = max(models, key=lambda name: _extent(models[name][0]) if models[name] else (0, 0))
    sizes = tuple(model.num_reg_images() for model in models[camera])
    failure = f"scene {images.scene.name}: no poses from images alone"
    if not sizes:
        raise DatasetError(
            f"{failure}: no two of the {len(images)} images share enough features from positions far enough apart, as "
            f"where the vehicle stands, rotates in place, or drives by night; {REMEDY}"
        )
    key_frames, fraction = len({frame.sample_index for frame in images.frames}), job.refine_poses.limits.min_images
    if sizes[0] < fraction * key_frames:
        formed = "one model" if len(sizes) == 1 else f"{len(sizes)} models ({', '.join(map(str, sizes))} images)"
        raise DatasetError(
            f"{failure}: the images of {camera}, the best camera, form {formed}; the largest places {sizes[0]} of "
            f"{key_frames} key frames, less than refine_poses.limits.min_images, {fraction:g}; {REMEDY}"
        )
    largest, poses, points = models[camera][0], [], []
    numbers = sorted(largest.reg_image_ids())
    for number in numbers:
        image = largest.images[number]
        features = image.get_observation_points2D()
        pixels = np.array([feature.xy for feature in features]).reshape(-1, 2)
        seen = np.array([largest.points3D[feature.point3D_id].xyz for feature in features]).reshape(-1, 3)
        camera_from_model = image.cam_from_world().matrix()
        points.append(ImagePoints(pixels, seen @ camera_from_model[2, :3] + camera_from_model[2, 3]))
        poses.append(inverse(from_pycolmap(image.cam_from_world())))
    return MappedImages(camera, np.array(numbers) - 1, np.stack(poses), tuple(points), sizes)


def _models(
    images: RigImages, camera: str, database: Path, job: RefinePosesJob, threads: int
) -> list[pycolmap.Reconstruction]:
    """The mapper's models of a camera's images, the largest first. The options are those for a vehicle: mostly forward
    motion, small angles, calibrated cameras."""
    settings = job.refine_poses
    folder = database.parent / "models" / camera
    folder.mkdir(parents=True, exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions(
        random_seed=job.random_seed,
        num_threads=threads,
        extract_colors=False,
        min_model_size=MIN_MODEL_IMAGES,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
        ba_refine_sensor_from_rig=False,
    )
    options.mapper.random_seed = options.triangulation.random_seed = job.random_seed
    options.mapper.num_threads = threads
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_tri_angle = INITIAL_ANGLE
    options.mapper.abs_pose_min_num_inliers = settings.limits.min_points
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    options.mapper.filter_min_tri_angle = options.triangulation.min_angle = max(MIN_ANGLE, settings.min_angle)
    options.image_names = [image_name(number) for number in images.key_frames()[camera].values()]
    progress = MappingProgress(camera, len(options.image_names))
    models = pycolmap.incremental_mapping(
        database, database.parent, folder, options,
        initial_image_pair_callback=progress.begin_model, next_image_callback=progress.add_image,
    )  # fmt: skip
    return sorted(models.values(), key=_extent, reverse=True)


class MappingProgress:
    """Logs how many images of a camera the mapper has placed, at most every LOG_INTERVAL_S seconds."""

    def __init__(self, camera: str, images: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._camera, self._images, self._clock = camera, images, clock
        self._models = self._placed = 0
        self._begun = self._logged = clock()

    def begin_model(self) -> None:
        """The mapper has placed the first two images of a model; it tries another one where images are left."""
        self._models, self._placed = self._models + 1, 2
        self._begun = self._clock()
        log.info("camera %s: model %d begins, %d images", self._camera, self._models, self._images)

    def add_image(self) -> None:
        """The mapper has placed one more image."""
        self._placed += 1
        now = self._clock()
        if now - self._logged >= LOG_INTERVAL_S:
            self._logged = now
            left = (now - self._begun) / max(1, self._placed - 2) * max(0, self._images - self._placed)
            log.info(
                "camera %s: model %d, %d of %d images placed, about %.0f s left",
                self._camera, self._models, self._placed, self._images, left,
            )  # fmt: skip


def _extent(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.compute_num_observations()
