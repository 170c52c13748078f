"""The stage `export_usd`: a trained model with its moving objects and the recorded camera as scene.usdz."""

import logging
from pathlib import Path

import numpy as np
from pxr import Gf

from drivesplat.export.thinning import thinned_groups
from drivesplat.export.trained_parts import digests, trained_groups
from drivesplat.export.usd import splat_stage, usd_camera, write_usdz
from drivesplat.export.usd_splat import TIME_CODES_PER_SECOND
from drivesplat.io.storage import Provenance
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.rendering.trajectory import film_timestamps, recorded_frames, smooth_poses
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.scene import Scene
from drivesplat.settings.export import ExportJob

log = logging.getLogger(__name__)


def export_usd(
    path: str | Path, checkpoint: TrainedCheckpoint, scene: Scene, job: ExportJob, provenance: Provenance
) -> None:
    """Writes the `job.gaussians` Gaussians of a checkpoint with the largest coverage, and the recorded
    `job.eval_camera`. Raises DatasetError if the scene lacks that camera."""
    model = trained_model(checkpoint)
    cameras = recorded_cameras(scene, job.eval_camera)
    groups = trained_groups(model, scene, recorded_timestamps(scene, job.eval_camera))
    kept = thinned_groups(groups, job.gaussians)
    note = {"scene": scene.name, "dataset": scene.dataset, "origin": Gf.Vec3d(*scene.origin), **digests(provenance)}
    write_usdz(path, splat_stage(kept, cameras, note))
    before, after = (sum(len(group.gaussians) for group in of.values()) for of in (groups, kept))
    log.info("%d of %d Gaussians, %d groups, %d poses of %s", after, before, len(kept), len(cameras), job.eval_camera)


def recorded_cameras(scene: Scene, camera: str) -> list[tuple[float, Gf.Camera]]:
    """The USD cameras along a camera's recorded path, each with its time in seconds since the scene's first image.

    Images have their own poses; between them the path is that of films, sampled densely enough for USD, which
    interpolates matrices entry by entry. Raises DatasetError if the camera has no images.
    """
    frames = recorded_frames(scene, camera)
    recorded = recorded_timestamps(scene, camera)
    between = film_timestamps(frames[0].timestamp, frames[-1].timestamp, int(TIME_CODES_PER_SECOND))
    times = np.union1d(recorded, between)
    poses = smooth_poses(recorded, np.stack([frame.camera_to_world for frame in frames]), times)
    size = (frames[0].width, frames[0].height)
    K = continuous_intrinsics(frames[0], size)
    return [(scene.seconds(time), usd_camera(K, size, pose)) for time, pose in zip(times, poses, strict=True)]


def recorded_timestamps(scene: Scene, camera: str) -> np.ndarray:
    """The timestamps (n,) of a camera's images in microseconds: int64, increasing."""
    return np.array([frame.timestamp for frame in recorded_frames(scene, camera)], dtype=np.int64)
