"""The training images on the device, as uint8, with their cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from drivesplat.io.prefetch import prefetch
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.view import View, view_of
from drivesplat.scene.images import read_image
from drivesplat.scene.training_record import TrainingRecord


@dataclass(frozen=True)
class LidarDepth:
    """LiDAR depth of an image: at row-major pixel indices `pixels` (m,), `depth` (m,) in metres along the optical
    axis. The first `count` entries are used (None: all), which a device can change without Python."""

    pixels: Int[Tensor, " m"]
    depth: Float[Tensor, " m"]
    count: Int[Tensor, ""] | None = None


@dataclass(frozen=True)
class TrainingView:
    """A camera and its recorded image, with masks of `sky` and of `moving` objects, `lidar` depth, semantic `classes`
    (UNLABELLED: none) and the `ego_mask`; each None where it is unknown or not wanted. `not_sky` marks pixels that
    cannot show the sky; it is set only where `sky` is unknown. Pixels of the ego vehicle are in no other mask, have no
    class and no depth, and do not supervise the training."""

    view: View
    pixels: UInt8[Tensor, "h w 3"]
    sky: Bool[Tensor, "h w"] | None = None
    not_sky: Bool[Tensor, "h w"] | None = None
    moving: Bool[Tensor, "h w"] | None = None
    lidar: LidarDepth | None = None
    classes: UInt8[Tensor, "h w"] | None = None
    ego_mask: Bool[Tensor, "h w"] | None = None

    def target(self) -> Float[Tensor, "h w 3"]:
        """The recorded colours in [0, 1]."""
        return self.pixels.float() / 255.0


@dataclass(frozen=True)
class Supervision:
    """Data of training images beside their pixels, by image number: masks (h, w) bool of `sky`, of what cannot be sky
    (`not_sky`), of `moving` objects and of the ego vehicle (`ego_mask`), `classes` (h, w) uint8, and records of `lidar`
    (rows, columns, depth). Mappings of unused kinds are empty."""

    sky: Mapping[int, np.ndarray]
    moving: Mapping[int, np.ndarray]
    lidar: Mapping[int, PixelDepths]
    classes: Mapping[int, np.ndarray] = field(default_factory=dict)
    ego_mask: Mapping[int, np.ndarray] = field(default_factory=dict)
    not_sky: Mapping[int, np.ndarray] = field(default_factory=dict)


def load_views(
    record: TrainingRecord, supervision: Supervision, device: torch.device, images: Sequence[int] | None = None
) -> list[TrainingView]:
    """The images of a training record, by default those of training, with all masks at training resolution; a camera's
    images share the mask of the ego vehicle."""
    views: list[TrainingView] = []
    known_masks: dict[bytes, Tensor] = {}
    images = record.train_images if images is None else images
    recorded = prefetch(lambda i: read_image(record.image_paths[i], record.image_size(i)), images)
    for index, image in zip(images, recorded, strict=True):
        size = record.image_size(index)
        pixels = torch.from_numpy(image.copy()).to(device)
        sky, not_sky, moving, classes = (
            torch.from_numpy(masks[index].copy()).to(device) if index in masks else None
            for masks in (supervision.sky, supervision.not_sky, supervision.moving, supervision.classes)
        )
        body = supervision.ego_mask.get(index)
        lidar = _lidar_depth(supervision.lidar[index], size[0], body, device) if index in supervision.lidar else None
        ego_mask = _shared(body, known_masks, device) if body is not None and body.any() else None
        if not_sky is not None and ego_mask is not None:
            not_sky &= ~ego_mask
        view = view_of(record, index, device)
        views.append(TrainingView(view, pixels, sky, not_sky, moving, lidar, classes, ego_mask))
    return views


def _shared(mask: np.ndarray, known: dict[bytes, Tensor], device: torch.device) -> Tensor:
    """A mask (h, w) on the device; equal masks share one tensor."""
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


def view_index(count: int, step: int, seed: int) -> int:
    """The index of the view of a step: a new seeded permutation every epoch, independent of earlier steps."""
    epoch, position = divmod(step, count)
    return _epoch(count, epoch, seed)[position]


@lru_cache(maxsize=2)
def _epoch(count: int, epoch: int, seed: int) -> list[int]:
    """The order of the views in an epoch."""
    return np.random.default_rng((seed, epoch)).permutation(count).tolist()
