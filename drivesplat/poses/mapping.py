"""Poses from nothing but images: pycolmap's incremental mapper on the features and matches of a scene.

Every camera is mapped by itself, and the one that gets farthest places the car: the others are mounted on it. Together
they would hang on the few points that two of them see, and come apart. Intrinsics are fixed, and what the mapper makes
has no scale: only where the camera stood is taken from it, never where the car did, whose mounts are in metres.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from drivesplat.errors import DatasetError
from drivesplat.poses.features import image_name
from drivesplat.poses.rig import RigImages, from_pycolmap
from drivesplat.scene.rigid import inverse
from drivesplat.settings.refine_poses import RefinePosesJob

REMEDY = "such a drive needs recorded poses (refine_poses.start: recorded)"
"""What all failures of poses from images end in."""
MIN_ANGLE = 1.5
"""Rays that meet under a smaller angle (degrees) make no point while poses are still unknown: it would pull at them."""
FIRST_ANGLE = 6.0
"""Rays of the first two images meet under this angle (degrees) if any do, under a quarter of it at least."""
MIN_MODEL = 3
"""Fewer images than this are no model."""


@dataclass(frozen=True)
class Sightings:
    """Points in an image: `pixels` (m, 2), continuous, and how far off they are along the axis, `depth` (m,), in units
    of the model."""

    pixels: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class Model:
    """Images of one `camera` that were placed together: `placed` (n,), increasing, are their positions among a
    RigImages', and `camera_to_model` (n, 4, 4) their poses; each has its `sightings`. `sizes`: how many images every
    model of that camera has, this one's the first."""

    camera: str
    placed: np.ndarray
    camera_to_model: np.ndarray
    sightings: tuple[Sightings, ...]
    sizes: tuple[int, ...]

    def without(self, strays: np.ndarray) -> "Model":
        """The same without those of its images (n,) bool."""
        sightings = tuple(seen for seen, stray in zip(self.sightings, strays, strict=True) if not stray)
        return Model(self.camera, self.placed[~strays], self.camera_to_model[~strays], sightings, self.sizes)


def mapped(images: RigImages, database: Path, job: RefinePosesJob, threads: int) -> Model:
    """The largest model of one camera's images, whose features and matches are in `database`.

    Raises DatasetError where the mapper places none, or too few of them together.
    """
    made = {camera: _models(images, camera, database, job, threads) for camera in images.cameras}
    camera = max(made, key=lambda name: _extent(made[name][0]) if made[name] else (0, 0))
    sizes = tuple(model.num_reg_images() for model in made[camera])
    _require_enough(images, camera, sizes, job.refine_poses.limits.min_images)
    largest = made[camera][0]
    numbers = sorted(largest.reg_image_ids())
    return Model(
        camera,
        np.array(numbers) - 1,
        np.stack([inverse(from_pycolmap(largest.images[number].cam_from_world())) for number in numbers]),
        tuple(_sightings(largest, number) for number in numbers),
        sizes,
    )


def _models(
    images: RigImages, camera: str, database: Path, job: RefinePosesJob, threads: int
) -> list[pycolmap.Reconstruction]:
    """What the mapper makes of a camera's images, the largest first."""
    folder = database.parent / "models" / camera
    folder.mkdir(parents=True, exist_ok=True)
    options = _options(job, threads)
    options.image_names = [image_name(number) for number in images.key_frames()[camera].values()]
    models = pycolmap.incremental_mapping(database, database.parent, folder, options)
    return sorted(models.values(), key=_extent, reverse=True)


def _extent(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.compute_num_observations()


def _require_enough(images: RigImages, camera: str, sizes: tuple[int, ...], share: float) -> None:
    where = f"scene {images.scene.name}: images alone give no poses"
    if not sizes:
        raise DatasetError(
            f"{where}: no two of the {len(images)} show enough of the same from places far enough apart, as where the "
            f"car stands, turns on the spot, or drives by night; {REMEDY}"
        )
    key_frames = len({frame.sample_index for frame in images.frames})
    if sizes[0] < share * key_frames:
        models = "one model" if len(sizes) == 1 else f"{len(sizes)} models ({', '.join(map(str, sizes))} images)"
        raise DatasetError(
            f"{where}: those of {camera}, which get farthest, make {models}, so that {sizes[0]} of {key_frames} key "
            f"frames are placed together, less than refine_poses.limits.min_images, {share:g}; {REMEDY}"
        )


def _options(job: RefinePosesJob, threads: int) -> pycolmap.IncrementalPipelineOptions:
    """The mapper for a car: most of its motion is forward, under small angles, and cameras are as calibrated."""
    settings = job.refine_poses
    options = pycolmap.IncrementalPipelineOptions(
        random_seed=job.random_seed,
        num_threads=threads,
        extract_colors=False,
        min_model_size=MIN_MODEL,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
        ba_refine_sensor_from_rig=False,
    )
    options.mapper.random_seed = options.triangulation.random_seed = job.random_seed
    options.mapper.num_threads = threads
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_tri_angle = FIRST_ANGLE
    options.mapper.abs_pose_min_num_inliers = settings.limits.min_points
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    options.mapper.filter_min_tri_angle = max(MIN_ANGLE, settings.min_angle)
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle
    return options


def _sightings(model: pycolmap.Reconstruction, number: int) -> Sightings:
    image = model.images[number]
    seen = [point for point in image.points2D if point.has_point3D()]
    pixels = np.array([point.xy for point in seen]).reshape(-1, 2)
    points = np.array([model.points3D[point.point3D_id].xyz for point in seen]).reshape(-1, 3)
    camera_from_model = image.cam_from_world().matrix()
    return Sightings(pixels, points @ camera_from_model[2, :3] + camera_from_model[2, 3])
