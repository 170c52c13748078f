"""What a drive was like, beside its figures: how far the car came, how near held-out images are to training images, and
how bright they are."""

from typing import Any

import numpy as np

from drivesplat.evaluation.metrics import psnr
from drivesplat.scene.prepared_drive import Recording
from drivesplat.scene.regions import region_mask
from drivesplat.scene.scene_warnings import REC_709, moved, seconds_long, standing


def drive_record(recording: Recording, camera: str, measured: dict[str, list[int]]) -> dict[str, Any]:
    """The `drive` of metrics.json; `measured` are the images by held-out group.

    `moved_m`: metres between the two places where the car was farthest apart; `standing_s` of `seconds`. A group is
    None where it holds no image.
    """
    scene = recording.scene
    groups = {group: _group(recording, camera, images) if images else None for group, images in measured.items()}
    return {"moved_m": moved(scene), "seconds": seconds_long(scene), "standing_s": standing(scene), **groups}


def _group(recording: Recording, camera: str, images: list[int]) -> dict[str, float | None]:
    """`from_training_m`: metres from a held-out image to where the nearest training image of `camera` was taken, the
    mean over `images`; None without any. `luminance`: the mean luma of their pixels. `flat_psnr`: the PSNR in dB that
    their static pixels' mean colour has in place of a rendering, which a model has to beat; None without such pixels or
    where all are alike.
    """
    places = recording.record.camtoworlds[:, :3, 3]
    training = [i for i in recording.record.train_images if recording.frame(i).camera == camera]
    distances = np.linalg.norm(places[images][:, None] - places[training], axis=2)
    lumas, count, sums, squares = [], 0, np.zeros(3), np.zeros(3)
    for index in images:
        image = recording.image(index)
        lumas.append(float((image @ REC_709).mean()))
        static = image[region_mask(recording.labels(index), "static")]
        count, sums, squares = count + len(static), sums + static.sum(axis=0), squares + (static**2).sum(axis=0)
    variance = (squares / max(count, 1) - (sums / max(count, 1)) ** 2).mean()
    return {
        "from_training_m": float(distances.min(axis=1).mean()) if training else None,
        "luminance": float(np.mean(lumas)),
        "flat_psnr": psnr(float(variance)),
    }
