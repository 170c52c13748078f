"""What eval.json states in the same way for scenes with and without cameras: the training, the hold-out, and the
properties of a drive that its figures depend on: distance driven, distance of held-out images from training images, and
brightness."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from drivesplat.evaluation.metrics import psnr
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import region_mask
from drivesplat.scene.scene import Scene
from drivesplat.scene.scene_warnings import REC_709, duration, max_displacement, standing_time
from drivesplat.scene.splits import HELD_OUT_GROUPS
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


def summarize_drive(recording: EvaluationData, camera: str, measured: dict[str, list[int]]) -> dict[str, Any]:
    """The `drive` of metrics.json; `measured` are the images by held-out group.

    `moved_m`: the largest distance in metres between two ego positions; `standing_s`: seconds at standstill, of
    `seconds`. Of each group, None without images: `from_training_m`, the distance in metres from a held-out image to
    the nearest training image of `camera`, mean over the images, None without training images; `luminance`, the mean
    luma (Rec. 709) of their pixels; `flat_psnr`, the PSNR in dB of the mean colour of their static pixels, the trivial
    baseline, None without such pixels or if all are equal.
    """
    places, groups = recording.record.camtoworlds[:, :3, 3], {}
    training = [i for i in recording.record.train_images if recording.frame(i).camera == camera]
    for group, images in measured.items():
        lumas, count, sums, squares = [], 0, np.zeros(3), np.zeros(3)
        for index in images:
            image, static = recording.image(index), region_mask(recording.labels(index), "static")
            lumas.append(float(np.dot(cv2.mean(image)[:3], REC_709)))
            mean, deviation = (values[:, 0] for values in cv2.meanStdDev(image, mask=static.astype(np.uint8)))
            pixels = np.count_nonzero(static)
            count, sums, squares = count + pixels, sums + pixels * mean, squares + pixels * (mean**2 + deviation**2)
        groups[group] = None
        if images:
            distances = np.linalg.norm(places[images][:, None] - places[training], axis=2)
            variance = (squares / max(count, 1) - (sums / max(count, 1)) ** 2).mean()
            groups[group] = {
                "from_training_m": float(distances.min(axis=1).mean()) if training else None,
                "luminance": float(np.mean(lumas)),
                "flat_psnr": psnr(float(variance)),
            }
    return {**summarize_swept_drive(recording.scene), **groups}


def summarize_swept_drive(scene: Scene) -> dict[str, Any]:
    """The `drive` of the metrics.json of a scene without cameras: as `summarize_drive`, without figures of images."""
    times = {"seconds": duration(scene), "standing_s": standing_time(scene)}
    return {"moved_m": max_displacement(scene), **times, **dict.fromkeys(HELD_OUT_GROUPS)}
