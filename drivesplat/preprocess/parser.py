"""The stage `parser`: all that a trainer needs from a scene, in one record."""

from pathlib import Path
from typing import get_args

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.io.point_cloud import PointCloud
from drivesplat.scene.images import continuous_intrinsics, target_size
from drivesplat.scene.recorded_shutters import shutters
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import Group, frame_groups, held_out_key_frames, sweep_groups
from drivesplat.scene.training_record import SceneInfo, SeedInfo, TrainingRecord
from drivesplat.settings.images import ParserJob

NO_SEED = PointCloud(np.empty((0, 3), dtype=np.float32), np.empty((0, 3), dtype=np.uint8), {})
"""The seed points of a scene without images: trainings take theirs from scans."""


def training_record(scene: Scene, seed: PointCloud | None, job: ParserJob) -> TrainingRecord:
    """The training record of a scene and its seed points (None: there are no images that could give them colours),
    without provenance. Raises DatasetError where no training image is left, in a scene without images no sweep."""
    frames = scene.frames
    sizes = [target_size(frame, job.images) for frame in frames]
    cameras = list(dict.fromkeys(frame.camera for frame in frames))
    groups = np.array(frame_groups(scene, job.holdout), dtype=str)
    splits = {group: np.flatnonzero(groups == group) for group in get_args(Group)}
    if frames:
        placed = [frame.camera_to_world for frame, group in zip(frames, groups, strict=True) if group == "train"]
    else:
        swept = zip(scene.sweeps, sweep_groups(scene, job.holdout), strict=True)
        placed = [sweep.sensor_to_world for sweep, group in swept if group == "train"]
    centers = _stacked([pose[:3, 3] for pose in placed], 3)
    if len(centers) == 0:
        raise DatasetError(
            f"scene {scene.name}: no training {'image' if frames else 'sweep'} is left; "
            "hold out fewer key frames (holdout.every_nth, holdout.last_block)"
        )
    found, readout_s, velocities = shutters(scene), None, None
    if any(found):
        readout_s = np.stack([np.zeros(3) if shutter is None else shutter.readout_s for shutter in found])
        velocities = np.stack([np.zeros(6) if shutter is None else shutter.velocity for shutter in found])
    seed = NO_SEED if seed is None else seed
    return TrainingRecord(
        Ks=_stacked([continuous_intrinsics(frame, size) for frame, size in zip(frames, sizes, strict=True)], 3, 3),
        camtoworlds=_stacked([frame.camera_to_world for frame in frames], 4, 4),
        ego_to_world=_stacked([frame.ego_to_world for frame in frames], 4, 4),
        image_paths=[frame.image_path for frame in frames],
        image_names=[Path(frame.image_path).name for frame in frames],
        image_sizes=np.array(sizes, dtype=np.int64).reshape(-1, 2),
        camera_names=cameras,
        camera_indices=np.array([cameras.index(frame.camera) for frame in frames], dtype=np.int64),
        timestamps=np.array([frame.timestamp for frame in frames], dtype=np.int64),
        sample_indices=np.array([frame.sample_index for frame in frames], dtype=np.int64),
        is_key_frame=np.array([frame.is_key_frame for frame in frames], dtype=bool),
        points=seed.positions,
        points_rgb=seed.colors,
        scene_scale=max(1.0, float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())),
        splits=splits,
        held_out_frames=held_out_key_frames(scene, job.holdout),
        scene=SceneInfo(
            name=scene.name,
            dataset=scene.dataset,
            version=scene.version,
            poses=scene.poses,
            key_frame_range=scene.key_frame_range,
            missing_images=scene.missing_images,
            key_frame_hz=scene.key_frame_hz,
        ),
        seed=SeedInfo(**{key: value for key, value in seed.note.items() if key != "provenance"}),
        readout_s=readout_s,
        camera_velocities=velocities,
    )


def _stacked(values: list[np.ndarray], *shape: int) -> np.ndarray:
    """Arrays of a `shape` along a new first axis, which may be empty."""
    return np.stack(values) if values else np.empty((0, *shape))
