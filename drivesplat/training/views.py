"""The training images on the device, as bytes, with their cameras."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from drivesplat.images import read_image
from drivesplat.model.splat_model import View
from drivesplat.parser import image_size


@dataclass(frozen=True)
class TrainingView:
    """A camera and what it recorded; `sky` is True where the sky is, None where that is unknown."""

    view: View
    pixels: UInt8[Tensor, "h w 3"]
    sky: Bool[Tensor, "h w"] | None

    def target(self) -> Float[Tensor, "h w 3"]:
        """The recorded colours in [0, 1]."""
        return self.pixels.float() / 255.0


def view_of(parser: dict[str, Any], index: int, device: torch.device) -> View:
    """Image `index` of a parser record as a camera."""
    width, height = image_size(parser, index)
    seconds = float(parser["timestamps"][index] - parser["timestamps"].min()) * 1e-6
    return View(
        K=torch.from_numpy(parser["Ks"][index]).float().to(device),
        camera_to_world=torch.from_numpy(parser["camtoworlds"][index]).float().to(device),
        width=width,
        height=height,
        time=seconds,
    )


def load_views(
    parser: dict[str, Any], sky_masks: dict[str, np.ndarray] | None, device: torch.device
) -> list[TrainingView]:
    """The training images of a parser record. `sky_masks` (h, w) bool by image path, at training resolution."""
    views = []
    for index in parser["splits"]["train"]:
        path = parser["image_paths"][index]
        pixels = torch.from_numpy(read_image(path, image_size(parser, index)).copy()).to(device)
        sky = torch.from_numpy(sky_masks[path]).to(device) if sky_masks else None
        views.append(TrainingView(view_of(parser, int(index), device), pixels, sky))
    return views


def order(count: int, step: int, seed: int) -> int:
    """Which of `count` views step `step` sees: a new seeded permutation every epoch, known without the steps before."""
    epoch, position = divmod(step, count)
    return int(np.random.default_rng((seed, epoch)).permutation(count)[position])
