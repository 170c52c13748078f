"""Gaussians in world coordinates, ready for the rasterizer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """n Gaussians: `means` and `scales` metres, `quats` w, x, y, z, `opacities` in [0, 1], `sh` RGB coefficients."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, chosen: Bool[Tensor, " n"] | Int[Tensor, " m"] | slice) -> "Gaussians":
        """Those that a mask, indices or a slice choose."""
        return Gaussians(**{f.name: getattr(self, f.name)[chosen] for f in fields(self)})

    @property
    def sh_degree(self) -> int:
        """The degree that the number of coefficients stands for: k = (degree + 1)²."""
        return math.isqrt(self.sh.shape[1]) - 1


def concatenate(sets: Sequence[Gaussians]) -> Gaussians:
    """Several sets as one, in order, all with as many SH coefficients as the richest; a single set is returned as it
    is."""
    if len(sets) == 1:
        return sets[0]
    coefficients = max(s.sh.shape[1] for s in sets)
    sets = [replace(s, sh=F.pad(s.sh, (0, 0, 0, coefficients - s.sh.shape[1]))) for s in sets]
    return Gaussians(**{f.name: torch.cat([getattr(s, f.name) for s in sets]) for f in fields(Gaussians)})
