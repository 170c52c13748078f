"""How good a picture is where other cameras of the rig see the same: seams show there, of exposures, clocks and poses
that do not agree."""

import numpy as np

from drivesplat.scene.training_record import TrainingRecord

OVERLAP_REGIONS = ("overlap", "no_overlap")


def seen_by_others(record: TrainingRecord, index: int) -> np.ndarray:
    """The pixels (h, w) bool of image `index` in whose direction another camera's image of the same key frame looks.

    By direction alone, as of what is far away: the cameras of a rig are a metre apart, and what is seen does not depend
    on any reconstruction's depth.
    """
    width, height = record.image_size(index)
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    rays = pixels @ np.linalg.inv(record.Ks[index]).T @ record.camtoworlds[index][:3, :3].T
    seen = np.zeros((height, width), dtype=bool)
    for other in _beside(record, index):
        ahead = rays @ record.camtoworlds[other][:3, :3] @ record.Ks[other].T
        depth = np.where(ahead[..., 2] > 0, ahead[..., 2], np.nan)
        x, y = ahead[..., 0] / depth, ahead[..., 1] / depth
        other_width, other_height = record.image_size(other)
        seen |= (x >= 0) & (x < other_width) & (y >= 0) & (y < other_height)
    return seen


def overlap_masks(record: TrainingRecord, index: int, static: np.ndarray) -> dict[str, np.ndarray]:
    """The `static` pixels (h, w) bool of an image in two: where another camera looks, too, and where none does."""
    seen = seen_by_others(record, index)
    return {"overlap": static & seen, "no_overlap": static & ~seen}


def _beside(record: TrainingRecord, index: int) -> list[int]:
    """The images of the other cameras at the key frame of image `index`."""
    same = record.is_key_frame & (record.sample_indices == record.sample_indices[index])
    return [int(i) for i in np.flatnonzero(same) if record.camera_indices[i] != record.camera_indices[index]]
