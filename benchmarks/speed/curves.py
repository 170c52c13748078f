"""Quality over training time: static PSNR on held-out frames at stops of a training, and the times to reach a value."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from drivesplat.evaluation.image_metrics import measured_images
from drivesplat.evaluation.metrics import MIN_REGION_PIXELS, psnr
from drivesplat.evaluation.synthetic import rendered
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View, view_of
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import region_masks

NEAR_DB = 0.3
"""How near to its own best value a training counts as having reached it."""

Point = dict[str, Any]
"""`iteration`, `seconds` and `static`: the PSNR of static pixels in dB."""


@dataclass(frozen=True)
class HeldOutFrame:
    """The static pixels of a held-out frame: its view, their mask, and their recorded colours in [0, 1]."""

    view: View
    static: Bool[np.ndarray, "h w"]
    colors: Float[np.ndarray, "m 3"]


@dataclass
class QualityCurve:
    """The static PSNR of held-out frames over the time of a training: its `points`, and the seconds `spent` on them."""

    frames: Sequence[HeldOutFrame]
    points: list[Point] = field(default_factory=list)
    spent: float = 0.0

    def see(self, step: int, seconds: float, model: SplatModel) -> None:
        """Measures a model; without pixels to measure no point is added."""
        began = time.monotonic()
        found = static_psnr(model, self.frames)
        if found is not None:
            self.points.append({"iteration": step, "seconds": seconds, "static": found})
        self.spent += time.monotonic() - began


def held_out_frames(recording: EvaluationData, camera: str, device: torch.device) -> list[HeldOutFrame]:
    """The frames of the first group of held-out frames that has some."""
    groups, frames = measured_images(recording.record, camera).values(), []
    for index in next((images for images in groups if images), []):
        static = region_masks(recording.labels(index))["static"]
        frames.append(HeldOutFrame(view_of(recording.record, index, device), static, recording.image(index)[static]))
    return frames


def static_psnr(model: SplatModel, frames: Sequence[HeldOutFrame]) -> float | None:
    """The PSNR over all static pixels of frames, as in `metrics.json`; None with fewer pixels than it takes there, or
    without an error."""
    squared_error, pixels = 0.0, 0
    for frame in frames:
        shown = rendered(model, frame.view)[frame.static].clip(0.0, 1.0)
        errors = np.square(shown.astype(np.float64) - frame.colors).mean(axis=1)
        squared_error, pixels = squared_error + float(errors.sum()), pixels + len(errors)
    return psnr(squared_error / pixels) if pixels >= MIN_REGION_PIXELS else None


def best_of(points: Sequence[Point]) -> float | None:
    """The highest PSNR of a curve."""
    return max((point["static"] for point in points), default=None)


def seconds_until(points: Sequence[Point], psnr: float | None) -> float | None:
    """The seconds of training after which a curve reaches a PSNR, linear between its points; None if it never does.

    >>> curve = [{"seconds": 1.0, "static": 20.0}, {"seconds": 3.0, "static": 24.0}, {"seconds": 5.0, "static": 23.0}]
    >>> seconds_until(curve, 23.0), seconds_until(curve, 19.0), seconds_until(curve, 25.0)
    (2.5, 1.0, None)
    """
    if psnr is None:
        return None
    before: Point | None = None
    for point in points:
        if point["static"] >= psnr:
            if before is None:
                return float(point["seconds"])
            part = (psnr - before["static"]) / (point["static"] - before["static"])
            return float(before["seconds"] + part * (point["seconds"] - before["seconds"]))
        before = point
    return None
