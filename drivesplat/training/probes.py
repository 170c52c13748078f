"""Measurements of the model during a training: stops for others, and PSNR curves. Nothing of them enters the
training."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from drivesplat.model.splat_model import SplatModel
from drivesplat.training.views import TrainingView

MAX_IMAGES = 3
"""Maximum number of images of a curve: rendering more would slow down short trainings."""

CurveViews = Mapping[str, Sequence[TrainingView]]
"""The images of each PSNR curve, by its name in TensorBoard."""


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


def evenly_spaced(images: Sequence[int]) -> list[int]:
    """Up to MAX_IMAGES of some images.

    >>> evenly_spaced([2, 3, 5, 7, 11, 13, 17])
    [2, 7, 17]
    """
    count = min(MAX_IMAGES, len(images))
    return [images[round(i * (len(images) - 1) / max(1, count - 1))] for i in range(count)]


@torch.no_grad()
def curve_psnrs(model: SplatModel, curves: CurveViews, sh_degree: int) -> dict[str, float]:
    """The PSNR of each curve in dB, from the mean squared error of all its pixels outside the ego vehicle; identical
    images are left out."""
    names = [name for name, views in curves.items() if views]
    if not names:
        return {}
    errors = torch.stack([_mean_squared_error(model, curves[name], sh_degree) for name in names])
    psnrs = (-10.0 * torch.log10(errors)).tolist()
    return {name: psnr for name, psnr in zip(names, psnrs, strict=True) if psnr != float("inf")}


def _mean_squared_error(model: SplatModel, views: Sequence[TrainingView], sh_degree: int) -> Tensor:
    errors = []
    for view in views:
        image = model.render(view.view, sh_degree).image.clamp(0.0, 1.0)
        error = (image - view.target()).square()
        errors.append((error if view.ego_mask is None else error[~view.ego_mask]).flatten())
    return torch.cat(errors).mean()
