"""One image of a drive, as it was recorded and as a model shows it: what a person is shown beside the figures."""

from dataclasses import dataclass

import numpy as np
import torch

from drivesplat.evaluation.held_out import held_out_images
from drivesplat.evaluation.synthetic import rendered
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.scene.prepared_drive import Recording
from drivesplat.scene.regions import region_mask
from drivesplat.scene.splits import HELD_OUT_GROUPS


@dataclass(frozen=True)
class Shown:
    """Image `index` of a recording, of held-out `group` (or 'train'): `recorded` and `rendered` (h, w, 3) in [0, 1]."""

    group: str
    index: int
    recorded: np.ndarray
    rendered: np.ndarray


def held_out_pair(model: SplatModel, recording: Recording, camera: str, device: torch.device) -> Shown:
    """The held-out key frame of `camera` that shows most of vehicles that move, between training frames where any are
    held out there, else beyond the last; where nothing is held out, a key frame that was trained on."""
    group, images = _candidates(recording, camera)
    moving = [int(region_mask(recording.labels(index), "moving_vehicle").sum()) for index in images]
    index = images[int(np.argmax(moving))] if any(moving) else images[len(images) // 2]
    picture = rendered(model, view_of(recording.record, index, device))
    return Shown(group, index, recording.image(index), picture.clip(0.0, 1.0))


def _candidates(recording: Recording, camera: str) -> tuple[str, list[int]]:
    for group in (*HELD_OUT_GROUPS, "train"):
        images = held_out_images(recording.record, group, camera)
        if images:
            return group, images
    raise ValueError(f"no key frame of {camera} takes part")
