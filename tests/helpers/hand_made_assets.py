"""Assets small enough that a test can say what comes out of them."""

from typing import Any

import numpy as np
import torch

from drivesplat.editing.assets.asset import Asset
from drivesplat.kernels.spherical_harmonics import SH_C0
from drivesplat.model.gaussians import Gaussians
from drivesplat.scene.object_class import ObjectClass

CAR = np.array([4.0, 2.0, 1.5])
RED, BLUE, GREEN, WHITE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9), (0.1, 0.7, 0.1), (0.9, 0.9, 0.9)
SIDES = {(0, 1): GREEN, (0, -1): WHITE, (1, 1): RED, (1, -1): BLUE}
"""The sides of `painted_box`, axis and sign: its front is green, its back white, its left red, its right blue."""


def asset_of(gaussians: Gaussians, **changes: Any) -> Asset:
    """A car of these Gaussians, none of them invented, but for `changes`."""
    nothing = torch.zeros(len(gaussians), dtype=torch.bool)
    values = {"name": "0001/street/it", "object_class": ObjectClass.CAR, "category": "vehicle.car", "size": CAR}
    return Asset(**{**values, "gaussians": gaussians, "invented": nothing, **changes})


def round_ones(places: Any, colors: Any, size: float = 0.07, opacity: float = 0.95) -> Gaussians:
    """Round Gaussians at places (n, 3) of an object's frame, of one colour each."""
    means = torch.from_numpy(np.asarray(places, dtype=np.float32))
    count = len(means)
    sh0 = (torch.tensor(colors).expand(count, 3).float() - 0.5)[:, None] / SH_C0
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    return Gaussians(
        means, quats, torch.full((count, 3), size), torch.full((count,), opacity), sh0, torch.zeros(count, 0, 3)
    )


def plate(axis: int, sign: int, size: np.ndarray = CAR, spacing: float = 0.1) -> np.ndarray:
    """Places (n, 3) on the side of a box across an axis."""
    half = size / 2.0
    along = np.arange(-half[1 - axis] + spacing / 2, half[1 - axis], spacing)
    grid = np.stack(np.meshgrid(along, np.arange(-half[2] + spacing / 2, half[2], spacing)), axis=-1).reshape(-1, 2)
    places = np.empty((len(grid), 3))
    places[:, axis], places[:, 1 - axis], places[:, 2] = sign * half[axis], grid[:, 0], grid[:, 1]
    return places


def painted_box(**changes: Any) -> Asset:
    """A car whose four sides have a colour each."""
    places = [plate(*side) for side in SIDES]
    colors = np.concatenate([np.tile(color, (len(own), 1)) for own, color in zip(places, SIDES.values(), strict=True)])
    return asset_of(round_ones(np.concatenate(places), colors.tolist()), **changes)


def rgb_of(gaussians: Gaussians) -> torch.Tensor:
    """The colours (n, 3) of Gaussians without their dependence on the direction."""
    return 0.5 + SH_C0 * gaussians.sh0[:, 0]


def filled_car(count: int = 400, sh_degree: int = 3, seed: int = 5, **changes: Any) -> Asset:
    """A car whose box is full of Gaussians of other lengths in each direction, in colours that depend on it."""
    generator = torch.Generator().manual_seed(seed)
    random = torch.rand(count, 7, generator=generator)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    sh = 0.2 * torch.randn(count, (sh_degree + 1) ** 2, 3, generator=generator)
    means = (random[:, :3] - 0.5) * torch.from_numpy(CAR).float()
    return asset_of(Gaussians.of(means, quats, 0.02 + 0.1 * random[:, 3:6], 0.3 + 0.6 * random[:, 6], sh), **changes)
