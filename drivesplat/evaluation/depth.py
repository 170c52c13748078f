"""How far off rendered depth is, by what LiDAR of held-out sweeps measured."""

from typing import Any

import numpy as np

from drivesplat.evaluation.metrics import LEAST_REGION_PIXELS
from drivesplat.lidar.depth import Depths


class DepthErrors:
    """The relative errors of rendered depth over a group of images: `add` each of which LiDAR tells something, then
    `summary`."""

    def __init__(self) -> None:
        self._errors: list[np.ndarray] = []

    def add(self, rendered: np.ndarray, known: Depths) -> None:
        """A rendered depth image (h, w) in metres, and what LiDAR says of it."""
        found = rendered[known["rows"], known["columns"]].astype(np.float64)
        self._errors.append(np.abs(found - known["depth"]) / known["depth"])

    def summary(self) -> dict[str, Any]:
        """`depth`: the median of |rendered - LiDAR's| / LiDAR's over all `pixels` of the group that LiDAR met, None
        where they are too few; no such entry where LiDAR tells nothing of any image."""
        if not self._errors:
            return {}
        errors = np.concatenate(self._errors)
        if len(errors) < LEAST_REGION_PIXELS:
            return {"depth": None}
        return {"depth": {"median_relative_error": float(np.median(errors)), "pixels": len(errors)}}
