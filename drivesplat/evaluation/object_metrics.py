"""The PSNR of every object in held-out images: which of them makes the figure of a region.

The figure of moving vehicles is often that of one or two of them, and varies between trainings as they do.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.evaluation.metrics import MIN_FRAME_PIXELS, channel_mean, psnr
from drivesplat.io.storage import Provenance, read_record
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import LABELS, labelled_hulls
from drivesplat.scene.tracks import Box


@dataclass(frozen=True)
class ObjectErrors:
    """A box in one image: the number of pixels whose nearest box it is, and the sum of their squared errors, means over
    channels."""

    box: Box
    pixels: int
    squared_error: float


def object_errors(
    recording: EvaluationData, index: int, image: np.ndarray, truth: np.ndarray, labels: np.ndarray
) -> list[ObjectErrors]:
    """The errors of a rendering of image `index` against the recorded one, both (h, w, 3) in [0, 1], by the boxes of
    dynamic classes that count in regions. Pixels of the ego vehicle in `labels` (h, w) belong to none."""
    hulls, owners, names = labelled_hulls(recording.scene, recording.frame(index), recording.size(index))
    owned = np.where(labels == LABELS["own_car"], -1, owners).ravel()
    errors = channel_mean((image.clip(0.0, 1.0) - truth) ** 2).ravel()
    pixels = np.bincount(owned[owned >= 0], minlength=len(hulls))
    sums = np.bincount(owned[owned >= 0], weights=errors[owned >= 0], minlength=len(hulls))
    counted = [i for i, name in enumerate(names) if name != "left_out" and pixels[i]]
    return [ObjectErrors(hulls[i].box, int(pixels[i]), float(sums[i])) for i in counted]


def object_figures(path: str | Path) -> tuple[dict[str, dict[str, Any]], Provenance]:
    """The PSNR and the number of images of each track in every group of held-out images, by track and group, from
    eval_objects.json; and the provenance of that file. Raises ResultError where it is not one."""
    content, found = read_record(path, "evaluate", "groups", "provenance"), {}
    for group, objects in content["groups"].items():
        for item in objects:
            figures = {"psnr": item["psnr"], "images": item["images"]}
            found.setdefault(item["id"], {})[group] = figures
    return found, content["provenance"]


def by_object(errors: Iterable[ObjectErrors]) -> list[dict[str, Any]]:
    """A record of each track, that with most pixels first: `id`, `class`, `category` (the dataset's class), the numbers
    of `images` and `pixels`, `mean_speed` in m/s, whether it `moves` in any of them, and `psnr` in dB, pooled over the
    images; None for fewer than MIN_FRAME_PIXELS pixels."""
    tracks: dict[str, list[ObjectErrors]] = {}
    for one in errors:
        tracks.setdefault(one.box.track_id, []).append(one)
    records = []
    for track, own in tracks.items():
        pixels, box = sum(one.pixels for one in own), own[0].box
        records.append(
            {
                "id": track,
                "class": box.object_class.value,
                "category": box.category,
                "images": len(own),
                "pixels": pixels,
                "mean_speed": float(np.mean([one.box.speed for one in own])),
                "moves": any(one.box.moves for one in own),
                "psnr": psnr(sum(one.squared_error for one in own) / pixels) if pixels >= MIN_FRAME_PIXELS else None,
            }
        )
    return sorted(records, key=lambda record: (-record["pixels"], record["id"]))
