"""Training images by iteration: reduced at first, whole at the end."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.model.view import View
from drivesplat.settings.train import TrainSettings
from drivesplat.training.views import LidarDepth, TrainingView, order


class TrainingImages:
    """What a training sees: `views` in a seeded order, in which every one comes once an epoch, each reduced as
    `settings.coarse_to_fine` has it. Reduced ones are held for as long as they are in use."""

    def __init__(self, views: Sequence[TrainingView], settings: TrainSettings, seed: int):
        self.views = views
        self._settings = settings
        self._seed = seed
        self._factor, self._reduced = 1, views

    def at(self, step: int) -> TrainingView:
        """The image of an iteration."""
        factor = self.factor(step)
        if factor != self._factor:
            self._reduced = self.views if factor == 1 else [reduced(view, factor) for view in self.views]
            self._factor = factor
        return self._reduced[self.number(step)]

    def number(self, step: int) -> int:
        """Which image it is, of all `views`."""
        return order(len(self.views), step, self._seed)

    def factor(self, step: int) -> int:
        """By how much width and height are reduced at an iteration."""
        done, coarse = step / self._settings.iterations, self._settings.coarse_to_fine
        wanted = 4 if done < coarse.quarter_until else 2 if done < coarse.half_until else 1
        return next((factor for factor in (4, 2) if factor <= wanted and self._rows >= factor * coarse.least_height), 1)

    @cached_property
    def _rows(self) -> int:
        """Those of the lowest image, 0 without any."""
        return min((view.view.height for view in self.views), default=0)


def reduced(view: TrainingView, factor: int) -> TrainingView:
    """A view at a `factor`-th of its width and height: colours averaged over blocks of pixels; sky, and what moves,
    where most of a block is that, the own car where any of it is; of LiDAR every return, of classes those of blocks'
    middles. What of the right and lower edge fills no block is left out."""
    width, height = view.view.width // factor, view.view.height // factor
    K = view.view.K.clone()
    K[:2] /= factor
    camera = View(K, view.view.camera_to_world, width, height, view.view.time, view.view.camera)
    colors = F.avg_pool2d(view.pixels.permute(2, 0, 1).float(), factor)
    return dataclasses.replace(
        view,
        view=camera,
        pixels=colors.round().to(torch.uint8).permute(1, 2, 0).contiguous(),
        sky=None if view.sky is None else _share(view.sky, factor) > 0.5,
        moving=None if view.moving is None else _share(view.moving, factor) > 0.5,
        own_car=None if view.own_car is None else _share(view.own_car, factor) > 0.0,
        lidar=None if view.lidar is None else _within(view.lidar, view.view.width, camera, factor),
        classes=None if view.classes is None else _middles(view.classes, factor),
    )


def _share(mask: Bool[Tensor, "h w"], factor: int) -> Float[Tensor, "..."]:
    """How much of every block a mask covers."""
    return F.avg_pool2d(mask.float()[None], factor)[0]


def _middles(values: Tensor, factor: int) -> Tensor:
    """Those of an image (h, w) in the middle of every block."""
    rows, columns = (size // factor for size in values.shape)
    return values[factor // 2 :: factor, factor // 2 :: factor][:rows, :columns].contiguous()


def _within(lidar: LidarDepth, width: int, reduced: View, factor: int) -> LidarDepth | None:
    """What LiDAR measured in an image of `width`, by the pixels of the `reduced` one; None where nothing is left."""
    rows, columns = lidar.pixels // width // factor, lidar.pixels % width // factor
    seen = (rows < reduced.height) & (columns < reduced.width)
    if not bool(seen.any()):
        return None
    return LidarDepth((rows * reduced.width + columns)[seen], lidar.depth[seen])
