"""Errors of rendered depth against that of held-out LiDAR sweeps or of a synthetic world."""

from typing import Any

import numpy as np

from drivesplat.evaluation.metrics import MIN_REGION_PIXELS
from drivesplat.lidar.depth_record import PixelDepths


class DepthErrors:
    """Relative errors of rendered depth over a group of images: `add` each with its known depth, then `summary`."""

    def __init__(self) -> None:
        self._errors: list[np.ndarray] = []

    def add(self, rendered: np.ndarray, known: PixelDepths) -> None:
        """Adds a rendered depth image (h, w) in metres and its known depth."""
        found = rendered[known.rows, known.columns].astype(np.float64)
        self._errors.append((np.abs(found - known.depth) / known.depth).astype(np.float32))

    def summary(self) -> dict[str, Any]:
        """`depth`: the median of |rendered - known| / known over all `pixels` of the group with known depth, None if
        there are too few; an empty record if no image has known depth."""
        if not self._errors:
            return {}
        errors = np.concatenate(self._errors)
        if len(errors) < MIN_REGION_PIXELS:
            return {"depth": None}
        return {"depth": {"median_relative_error": float(np.median(errors)), "pixels": len(errors)}}
