"""A recorded image and its rendering, as a sample beside the figures."""

from dataclasses import dataclass

import numpy as np
import torch

from drivesplat.evaluation.held_out import held_out_images
from drivesplat.evaluation.synthetic import rendered
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.scene.prepared_drive import PreparedDrive
from drivesplat.scene.regions import region_mask
from drivesplat.scene.splits import HELD_OUT_GROUPS


@dataclass(frozen=True)
class SamplePair:
    """Image `index` of a recording, of held-out `group` (or 'train'): `recorded` and `rendered` (h, w, 3) in [0, 1]."""

    group: str
    index: int
    recorded: np.ndarray
    rendered: np.ndarray


def render_sample_pair(model: SplatModel, recording: PreparedDrive, camera: str, device: torch.device) -> SamplePair:
    """The held-out key frame of `camera` with the most pixels of moving vehicles, from the first group with held-out
    frames; a training key frame if nothing is held out."""
    group, images = _candidates(recording, camera)
    moving = [int(region_mask(recording.labels(index), "moving_vehicle").sum()) for index in images]
    index = images[int(np.argmax(moving))] if any(moving) else images[len(images) // 2]
    picture = rendered(model, view_of(recording.record, index, device))
    return SamplePair(group, index, recording.image(index), picture.clip(0.0, 1.0))


def _candidates(recording: PreparedDrive, camera: str) -> tuple[str, list[int]]:
    for group in (*HELD_OUT_GROUPS, "train"):
        images = held_out_images(recording.record, group, camera)
        if images:
            return group, images
    raise ValueError(f"no key frame of {camera} takes part")
