"""The training images on the device, as bytes, with their cameras."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from drivesplat.io.prefetch import ahead
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.view import View, view_of
from drivesplat.scene.images import read_image
from drivesplat.scene.training_record import TrainingRecord


@dataclass(frozen=True)
class LidarDepth:
    """What LiDAR measured in an image: at `pixels` (m,), counted row by row, `depth` (m,) metres along the axis."""

    pixels: Int[Tensor, " m"]
    depth: Float[Tensor, " m"]


@dataclass(frozen=True)
class TrainingView:
    """A camera and what it recorded; `sky` and `moving` are True where the sky is and where something moves, None where
    that is unknown or not wanted; so are `lidar`, the `classes` of its pixels (UNLABELLED: none) and the pixels of the
    `own_car`, which are neither sky nor moving, have no class and no depth, and of which nothing is to be learned."""

    view: View
    pixels: UInt8[Tensor, "h w 3"]
    sky: Bool[Tensor, "h w"] | None = None
    moving: Bool[Tensor, "h w"] | None = None
    lidar: LidarDepth | None = None
    classes: UInt8[Tensor, "h w"] | None = None
    own_car: Bool[Tensor, "h w"] | None = None

    def target(self) -> Float[Tensor, "h w 3"]:
        """The recorded colours in [0, 1]."""
        return self.pixels.float() / 255.0


@dataclass(frozen=True)
class Guides:
    """What is known of training images beside their pixels, by their number: masks (h, w) bool of the `sky` and of what
    is `moving`, of the `own_car`, `classes` (h, w) uint8, and the records of `lidar` (rows, columns, depth); an empty
    mapping where a guide is not wanted."""

    sky: Mapping[int, np.ndarray]
    moving: Mapping[int, np.ndarray]
    lidar: Mapping[int, PixelDepths]
    classes: Mapping[int, np.ndarray] = field(default_factory=dict)
    own_car: Mapping[int, np.ndarray] = field(default_factory=dict)


def load_views(record: TrainingRecord, guides: Guides, device: torch.device) -> list[TrainingView]:
    """The training images of a training record, with all masks at training resolution; a camera's images share the mask
    of the own car."""
    views: list[TrainingView] = []
    bodies: dict[bytes, Tensor] = {}
    images = record.train_images
    recorded = ahead(lambda i: read_image(record.image_paths[i], record.image_size(i)), images)
    for index, image in zip(images, recorded, strict=True):
        size = record.image_size(index)
        pixels = torch.from_numpy(image.copy()).to(device)
        sky, moving, classes = (
            torch.from_numpy(masks[index].copy()).to(device) if index in masks else None
            for masks in (guides.sky, guides.moving, guides.classes)
        )
        body = guides.own_car.get(index)
        lidar = _lidar_depth(guides.lidar[index], size[0], body, device) if index in guides.lidar else None
        own_car = _shared(body, bodies, device) if body is not None and body.any() else None
        views.append(TrainingView(view_of(record, index, device), pixels, sky, moving, lidar, classes, own_car))
    return views


def _shared(mask: np.ndarray, known: dict[bytes, Tensor], device: torch.device) -> Tensor:
    """A mask (h, w) on the device, once for all that are the same."""
    key = np.packbits(mask).tobytes()
    if key not in known:
        known[key] = torch.from_numpy(mask.copy()).to(device)
    return known[key]


def _lidar_depth(record: PixelDepths, width: int, body: np.ndarray | None, device: torch.device) -> LidarDepth | None:
    rows, columns, depth = record.rows, record.columns, record.depth
    if body is not None:
        seen = ~body[rows, columns]
        rows, columns, depth = rows[seen], columns[seen], depth[seen]
    if len(depth) == 0:
        return None
    pixels = rows.astype(np.int64) * width + columns
    return LidarDepth(torch.from_numpy(pixels).to(device), torch.from_numpy(depth).float().to(device))


def order(count: int, step: int, seed: int) -> int:
    """Which of `count` views step `step` sees: a new seeded permutation every epoch, known without the steps before."""
    epoch, position = divmod(step, count)
    return _epoch(count, epoch, seed)[position]


@lru_cache(maxsize=2)
def _epoch(count: int, epoch: int, seed: int) -> list[int]:
    """The order of an epoch's views, worked out once for all of its steps."""
    return np.random.default_rng((seed, epoch)).permutation(count).tolist()
