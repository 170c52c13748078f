"""The shadows of inserted objects: the ground that they darken.

The Gaussians of the static parts that lie on the ground beside and below a box lose a share of their brightness. Depth,
LiDAR and masks of objects stay as they are.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from drivesplat.kernels.quaternions import rotation_matrix
from drivesplat.kernels.spherical_harmonics import SH_C0
from drivesplat.model.gaussians import Gaussians
from drivesplat.scene.light import RIM, Shade, contact_shadow, hides_sun

LAYER = 0.3
"""Metres above and below the floor of a box within which Gaussians lie on its ground."""
BELOW, INSET = 0.5, 0.15
"""The least share of brightness that ground below a box loses, farther than INSET metres from its rim."""
SPREAD = 0.7
"""Where a Gaussian is looked at beside its centre, in standard deviations along its two longest axes."""


def shaded(gaussians: Gaussians, shades: Sequence[tuple[np.ndarray, Shade]]) -> Gaussians:
    """Static Gaussians in the shadows of boxes, each with its pose (4, 4) in the world."""
    kept = torch.ones_like(gaussians.opacities)
    for pose, shade in shades:
        rows = _near(gaussians.means, pose, shade)
        if len(rows):
            kept[rows] *= torch.from_numpy(1.0 - _lost(gaussians[rows], pose, shade)).to(kept)
    if not bool((kept < 1.0).any()):
        return gaussians
    share = kept[:, None, None]
    sh0 = share * gaussians.sh0 + (share - 1.0) * (0.5 / SH_C0)  # a colour is 0.5 plus its harmonics
    return replace(gaussians, sh0=sh0, shN=share * gaussians.shN)


def _near(means: Tensor, pose: np.ndarray, shade: Shade) -> Tensor:
    """The indices (n,) of Gaussians on the ground that the shadow of a box may reach."""
    size, sun = shade.size, shade.light.sun
    reach = 3.0 * RIM * size[2] if sun is None else max(3.0 * RIM, 1.0 / np.tan(np.arcsin(sun[2]))) * size[2]
    to_box = torch.from_numpy(np.linalg.inv(pose)).to(means)
    local = means @ to_box[:3, :3].T + to_box[:3, 3]
    half = torch.from_numpy(np.asarray(size) / 2.0).to(means)
    on_ground = (local[:, 2] + half[2]).abs() < LAYER
    return (on_ground & (local[:, :2].abs() < half[:2] + reach).all(dim=1)).nonzero()[:, 0]


def _lost(gaussians: Gaussians, pose: np.ndarray, shade: Shade) -> np.ndarray:
    """The share (n,) of brightness that Gaussians lose."""
    means = gaussians.means.double().cpu().numpy()
    count, rotation = len(means), pose[:3, :3]
    sizes = np.tile(np.asarray(shade.size, dtype=np.float64), (count, 1))
    local = (means - pose[:3, 3]) @ rotation
    local[:, 2] = -sizes[:, 2] / 2.0  # seen on the ground, wherever the centre is
    lost = shade.light.contact * contact_shadow(local, sizes)
    below = (np.abs(local[:, :2]) < sizes[:, :2] / 2.0 - INSET).all(axis=1)
    lost = np.where(below, np.maximum(lost, BELOW), lost)
    if shade.light.sun is None:
        return lost
    axes = (rotation_matrix(gaussians.quats) * gaussians.scales[:, None]).double().cpu().numpy()
    order = np.argsort(-np.linalg.norm(axes, axis=1), axis=1)[:, :2]
    longest = np.take_along_axis(axes, order[:, None], axis=2)  # (n, 3, 2)
    sun = np.tile(shade.light.sun @ rotation, (count, 1))
    hidden = np.zeros(count)
    steps = [(0.0, 0.0), (SPREAD, 0.0), (-SPREAD, 0.0), (0.0, SPREAD), (0.0, -SPREAD)]
    for step in steps:
        offset = (longest @ np.array(step)) @ rotation
        offset[:, 2] = 0.0
        hidden += hides_sun(local + offset, sizes, sun) / len(steps)
    return 1.0 - (1.0 - lost) * (1.0 - shade.light.cast * hidden)
