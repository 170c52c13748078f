"""The sides of an asset that no camera saw, made of its other side.

Vehicles and people are nearly symmetric about the plane through their x and z axes. A side that cameras saw, mirrored,
stands where none did; the Gaussians that a training left there, which no image holds in place, go.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.editing.assets.asset import Asset
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.harmonics import rotation_of_harmonics_by

VISIBLE = np.radians(75.0)
"""A surface is seen from directions within this of the one that it faces; at grazing angles it is not."""


def completed(asset: Asset) -> Asset:
    """The asset with the sides that no camera saw mirrored from those that cameras saw, marked as invented. Sides
    whose mirror image was not seen either stay as they are. An asset of unknown `seen` is unchanged."""
    if not len(asset.seen):
        return asset
    gaussians = asset.gaussians
    facing = facing_azimuths(gaussians.means, asset.size)
    own, opposite = seen_from(facing, asset.seen), seen_from(-facing, asset.seen)
    kept, copied = own | ~opposite, own & ~opposite
    if not bool(copied.any()):
        return asset
    added = mirrored(gaussians[copied])
    joined = {name: torch.cat([values[kept], added.tensors[name]]) for name, values in gaussians.tensors.items()}
    invented = torch.cat([asset.invented[kept], torch.ones(len(added), dtype=torch.bool)])
    return replace(asset, gaussians=Gaussians(**joined), invented=invented)


def facing_azimuths(means: Float[Tensor, "n 3"], size: np.ndarray) -> Float[Tensor, " n"]:
    """The direction, radians to the left of the front, that the surface of a box faces nearest to each place."""
    half = torch.from_numpy(np.asarray(size)).to(means)[:2] / 2.0
    x, y = (means[:, :2] / half).unbind(dim=1)
    return torch.atan2(y, x)


def seen_from(facing: Float[Tensor, " n"], seen: np.ndarray) -> Bool[Tensor, " n"]:
    """Whether surfaces that face these azimuths are seen from any of the azimuths `seen` (s,)."""
    turns = facing[:, None] - torch.from_numpy(seen).to(facing)
    return torch.cos(turns).amax(dim=1) >= np.cos(VISIBLE)


def mirrored(gaussians: Gaussians) -> Gaussians:
    """The Gaussians reflected about the plane y = 0, with their colours and echoes by direction."""
    signs = gaussians.means.new_tensor([1.0, -1.0, 1.0])
    identity, side = gaussians.quats.new_tensor([[1.0, 0.0, 0.0, 0.0]]), gaussians.means.new_tensor([-1.0])
    reflection = rotation_of_harmonics_by(identity, gaussians.sh.shape[1], side)[0]
    sh = reflection @ gaussians.sh
    logits = gaussians.lidar_logits
    if logits is not None:
        logits = torch.cat([logits[:, :1], logits[:, 1:] * signs[:, None]], dim=1)
    quats = gaussians.quats * gaussians.quats.new_tensor([1.0, -1.0, 1.0, -1.0])
    reflected = Gaussians.of(gaussians.means * signs, quats, gaussians.scales, gaussians.opacities, sh)
    return replace(reflected, lidar_logits=logits)
