"""Measurements of the model during a training: stops for others, and PSNR curves. Nothing of them enters the
training."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from drivesplat.model.splat_model import SplatModel
from drivesplat.training.views import TrainingView

MAX_IMAGES, MAX_OF_GROUP = 3, 2
"""Maximum numbers of training images, and of images of each held-out group, of curves: rendering more would slow down
short trainings."""


@dataclass(frozen=True)
class CurveImage:
    """An image of PSNR curves: the `curves` that it is part of, by their names in TensorBoard, with the pixels that
    count (None: all). Pixels of the ego vehicle never do."""

    view: TrainingView
    curves: Mapping[str, Bool[Tensor, "h w"] | None]


@dataclass(frozen=True)
class Probes:
    """`count` stops of a training, after equal numbers of steps, the last one at its end. `see` then gets the number of
    steps so far, the seconds of training until then, which do not include earlier stops, and the model. It must leave
    the model as it is."""

    count: int
    see: Callable[[int, float, SplatModel], None]

    def due(self, step: int, steps: int) -> bool:
        """Whether a training of so many steps stops after its first `step`.

        >>> probes = Probes(4, lambda *_: None)
        >>> [step for step in range(1, 11) if probes.due(step, 10)]
        [3, 5, 8, 10]
        """
        return step * self.count // steps > (step - 1) * self.count // steps

    def stop(self, step: int, seconds: float, model: SplatModel) -> float:
        """Shows the model, without gradients. Returns the seconds that this took."""
        began = time.monotonic()
        with torch.no_grad():
            self.see(step, seconds, model)
        return time.monotonic() - began


NO_PROBES = Probes(0, lambda *_: None)


def evenly_spaced(images: Sequence[int], count: int = MAX_IMAGES) -> list[int]:
    """Up to `count` of some images.

    >>> evenly_spaced([2, 3, 5, 7, 11, 13, 17])
    [2, 7, 17]
    """
    count = min(count, len(images))
    return [images[round(i * (len(images) - 1) / max(1, count - 1))] for i in range(count)]


@torch.no_grad()
def curve_psnrs(model: SplatModel, images: Sequence[CurveImage], sh_degree: int) -> dict[str, float]:
    """The PSNR of each curve in dB, from the mean squared error of all its pixels. Curves without pixels and identical
    images are left out."""
    sums: dict[str, Tensor] = {}
    for image in images:
        view = image.view
        rendered = model.render(view.view, sh_degree).image.clamp(0.0, 1.0)
        error = (rendered - view.target()).square().mean(dim=-1).double()
        for name, counted in image.curves.items():
            weights = torch.ones_like(error) if counted is None else counted.to(error)
            if view.ego_mask is not None:
                weights = weights * ~view.ego_mask
            sums[name] = sums.get(name, 0.0) + torch.stack([(error * weights).sum(), weights.sum()])
    if not sums:
        return {}
    found = zip(sums, torch.stack([*sums.values()]).tolist(), strict=True)
    return {name: -10.0 * math.log10(error / pixels) for name, (error, pixels) in found if error and pixels}
