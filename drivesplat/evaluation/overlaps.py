"""Regions where the fields of view of several cameras overlap, and where differing exposures, clocks and poses cause
seams."""

import numpy as np

from drivesplat.scene.training_record import TrainingRecord

OVERLAP_REGIONS = ("overlap", "no_overlap")


def seen_by_others(record: TrainingRecord, index: int) -> np.ndarray:
    """The pixels (h, w) bool of image `index` whose viewing direction lies in another camera's image of that key frame.

    Only directions count, as for distant points: cameras are about a metre apart, and no reconstructed depth is needed.
    """
    width, height = record.image_size(index)
    columns, rows = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
    to_world = record.camtoworlds[index][:3, :3] @ np.linalg.inv(record.Ks[index])
    seen = np.zeros((height, width), dtype=bool)
    for other in _simultaneous(record, index):
        homography = record.Ks[other] @ record.camtoworlds[other][:3, :3].T @ to_world
        x, y, depth = (of_column * columns + (of_row * rows + constant) for of_column, of_row, constant in homography)
        other_width, other_height = record.image_size(other)
        inside = (x >= 0) & (x < other_width * depth) & (y >= 0) & (y < other_height * depth)
        seen |= inside & (depth > 0)
    return seen


def overlap_masks(record: TrainingRecord, index: int, static: np.ndarray) -> dict[str, np.ndarray]:
    """The `static` pixels (h, w) bool of an image, split into those that other cameras see as well and the others."""
    seen = seen_by_others(record, index)
    return {"overlap": static & seen, "no_overlap": static & ~seen}


def _simultaneous(record: TrainingRecord, index: int) -> list[int]:
    """The images of the other cameras at the key frame of image `index`."""
    same = record.is_key_frame & (record.sample_indices == record.sample_indices[index])
    return [int(i) for i in np.flatnonzero(same) if record.camera_indices[i] != record.camera_indices[index]]
