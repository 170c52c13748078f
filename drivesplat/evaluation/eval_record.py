"""What eval.json states in the same way for scenes with and without cameras: the training and the hold-out."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drivesplat.settings.images import NEIGHBOURHOOD_HZ, HoldoutSettings


def training_figures(summary: dict[str, Any]) -> dict[str, Any]:
    """The figures of a training in eval.json; `summary` is the content of train.json."""
    return {
        "gaussians": summary["gaussians"],
        "train_seconds": summary["seconds"],
        "train_iterations": summary["iterations"],
        "peak_gpu_memory_gb": summary["peak_gpu_memory_gb"],
        "device": summary["device"],
        "random_seed": summary["random_seed"],
    }


def holdout_figures(holdout: HoldoutSettings, key_frame_hz: float | None) -> dict[str, Any]:
    """The settings of a hold-out as far as they have an effect at this rate of key frames: without the neighbourhood
    below NEIGHBOURHOOD_HZ, and without `cameras` if all are trained on."""
    unused = {"neighbourhood_s": not _dense(key_frame_hz), "cameras": not holdout.cameras}
    return holdout.model_dump(mode="json", exclude={name for name, is_unused in unused.items() if is_unused})


def rate_figures(key_frame_hz: float | None, held_out: ArrayLike, training: ArrayLike) -> dict[str, Any]:
    """At NEIGHBOURHOOD_HZ and more, the rate of key frames, and the least time in seconds between a held-out and a
    training recording, None where either is missing; below, nothing. `held_out` and `training` are their timestamps in
    microseconds."""
    if not _dense(key_frame_hz):
        return {}
    apart = np.abs(np.subtract.outer(held_out, training))
    return {"key_frame_hz": key_frame_hz, "nearest_training_s": float(apart.min()) * 1e-6 if apart.size else None}


def _dense(key_frame_hz: float | None) -> bool:
    return key_frame_hz is not None and key_frame_hz >= NEIGHBOURHOOD_HZ
