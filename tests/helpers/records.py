"""Records between stages, made by hand."""

from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.io.array_file import write_arrays
from drivesplat.model.checkpoint import TrainedCheckpoint
from drivesplat.scene.masks import MasksRecord
from drivesplat.scene.scan import Scan
from drivesplat.scene.scan_record import NO_OBJECT, RecordedScan
from drivesplat.scene.training_record import SceneInfo, SeedInfo, TrainingRecord
from drivesplat.settings.train import TrainJob, TrainSettings

EMPTY_CHECKPOINT = TrainedCheckpoint(
    {}, TrainJob(parts=("background",), sky="none", train=TrainSettings(), random_seed=0), [], {}
)
"""For functions whose model a test sets."""

EMPTY_MASKS = MasksRecord({}, 0, "boxes", "heuristic", 0.0, False, 0, {}, None)


def training_record_of(images: int, **fields: Any) -> TrainingRecord:
    """A training record of `images` images by CAM_FRONT, half a second apart; all are for training but for what
    `fields` say."""
    poses, indices = np.tile(np.eye(4), (images, 1, 1)), np.arange(images)
    names = [f"{i}.png" for i in indices]
    defaults = {
        "Ks": np.tile(np.eye(3), (images, 1, 1)), "camtoworlds": poses, "ego_to_world": poses, "image_paths": names,
        "image_names": names, "image_sizes": np.tile([64, 48], (images, 1)), "camera_names": ["CAM_FRONT"],
        "camera_indices": np.zeros(images, dtype=np.int64), "timestamps": 1_532_402_927_000_000 + 500_000 * indices,
        "sample_indices": indices, "is_key_frame": np.ones(images, dtype=bool), "points": np.zeros((1, 3), np.float32),
        "points_rgb": np.zeros((1, 3), np.uint8), "scene_scale": 1.0, "splits": {"train": indices},
        "held_out_frames": {}, "scene": SceneInfo("0001", "tiny", "v1.0-mini", "nuscenes"), "seed": SeedInfo(),
    }  # fmt: skip
    return TrainingRecord(**{**defaults, **fields})


def recorded_scan(
    scan: Scan, sensor_to_world: np.ndarray, timestamp: int = 0, sample_index: int = 0, **fields: Any
) -> RecordedScan:
    """A revolution of a standing sensor at a key frame, for training, that measures on every ray and meets no object;
    `fields` replace that."""
    shape, none = scan.returned.shape, np.zeros(3)
    defaults = {
        "lidar": "TOP", "seconds": timestamp * 1e-6, "is_key_frame": True, "group": "train", "linear": none,
        "angular": none, "measured": np.ones(shape, dtype=bool), "objects": np.full(shape, NO_OBJECT, dtype=np.int16),
        "blocked": np.zeros(shape, dtype=bool),
    }  # fmt: skip
    at = {"sensor_to_world": sensor_to_world, "timestamp": timestamp, "sample_index": sample_index}
    return RecordedScan(scan=scan, **at, **{**defaults, **fields})


def write_invalid(path: Path, content: Any) -> None:
    """Writes bytes as they are and a dict as an array file; anything else as an empty file, None as no file."""
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else b"")
    if isinstance(content, dict):
        write_arrays(path, content)
