"""The properties of a drive that its figures depend on: distance driven, distance of held-out images from training
images, and brightness."""

from typing import Any

import cv2
import numpy as np

from drivesplat.evaluation.metrics import psnr
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import region_mask
from drivesplat.scene.scene import Scene
from drivesplat.scene.scene_warnings import REC_709, duration, max_displacement, standing_time
from drivesplat.scene.splits import HELD_OUT_GROUPS


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
