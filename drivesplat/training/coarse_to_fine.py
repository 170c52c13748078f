"""Training images by step: reduced at first, at full size in the end."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.model.view import View
from drivesplat.training.schedule import Schedule
from drivesplat.training.views import LidarDepth, TrainingView, view_index


class TrainingImages:
    """The images of a training: `views` in a seeded order, each once per epoch, reduced as the schedule says. Reduced
    images are cached while their factor is in use."""

    def __init__(self, views: Sequence[TrainingView], schedule: Schedule, seed: int):
        self.views = views
        self._schedule = schedule
        self._seed = seed
        self._factor, self._reduced = 1, views

    def at(self, step: int) -> TrainingView:
        factor = self.factor(step)
        if factor != self._factor:
            self._reduced = self.views if factor == 1 else [reduced(view, factor) for view in self.views]
            self._factor = factor
        return self._reduced[self.number(step)]

    def number(self, step: int) -> int:
        """The index in `views` of the image of a step."""
        return view_index(len(self.views), self._schedule.images_before(step), self._seed)

    def factor(self, step: int) -> int:
        """The factor by which width and height are reduced at a step."""
        return self._schedule.reduction(step, self._rows)

    @cached_property
    def _rows(self) -> int:
        """The rows of the smallest image; 0 without images."""
        return min((view.view.height for view in self.views), default=0)


def reduced(view: TrainingView, factor: int) -> TrainingView:
    """A view at 1 / `factor` of its width and height. Colours are averaged over blocks of pixels; a block is sky or
    moving where most of its pixels are, ego vehicle where any is, and cannot be sky where none of them can. All LiDAR
    returns are kept; the class of a block is that of its centre. Incomplete blocks at the right and lower edge are
    dropped."""
    width, height = view.view.width // factor, view.view.height // factor
    K = view.view.K.clone()
    K[:2] /= factor
    camera = dataclasses.replace(view.view, K=K, width=width, height=height)
    colors = F.avg_pool2d(view.pixels.permute(2, 0, 1).float(), factor)
    return dataclasses.replace(
        view,
        view=camera,
        pixels=colors.round().to(torch.uint8).permute(1, 2, 0).contiguous(),
        sky=None if view.sky is None else _coverage(view.sky, factor) > 0.5,
        not_sky=None if view.not_sky is None else _coverage(view.not_sky, factor) == 1.0,
        moving=None if view.moving is None else _coverage(view.moving, factor) > 0.5,
        ego_mask=None if view.ego_mask is None else _coverage(view.ego_mask, factor) > 0.0,
        lidar=None if view.lidar is None else _within(view.lidar, view.view.width, camera, factor),
        classes=None if view.classes is None else _centres(view.classes, factor),
    )


def _coverage(mask: Bool[Tensor, "h w"], factor: int) -> Float[Tensor, "..."]:
    """The fraction of every block that a mask covers."""
    return F.avg_pool2d(mask.float()[None], factor)[0]


def _centres(values: Tensor, factor: int) -> Tensor:
    """The values of an image (h, w) at the centre of every block."""
    rows, columns = (size // factor for size in values.shape)
    return values[factor // 2 :: factor, factor // 2 :: factor][:rows, :columns].contiguous()


def _within(lidar: LidarDepth, width: int, reduced: View, factor: int) -> LidarDepth | None:
    """LiDAR depth of an image of `width` at the pixels of the `reduced` one; None where none is left."""
    rows, columns = lidar.pixels // width // factor, lidar.pixels % width // factor
    seen = (rows < reduced.height) & (columns < reduced.width)
    if not bool(seen.any()):
        return None
    return LidarDepth((rows * reduced.width + columns)[seen], lidar.depth[seen])
