"""Gaussians in world coordinates as the rasterizer takes them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drivesplat.kernels.spherical_harmonics import SH_C0


@dataclass(frozen=True)
class Gaussians:
    """n Gaussians: `means` and `scales` in metres, `quats` w, x, y, z, `opacities` in [0, 1], and spherical harmonics
    of RGB colours: `sh0` of degree 0, `shN` of the degrees above. `velocities` (m/s) are None where they are not known
    or all 0. `lidar_logits` are what a LiDAR measures of them, linear functions of the direction from the sensor: the
    logits of intensity and of a return are lidar_logits[:, 0] + direction @ lidar_logits[:, 1:]; None without LiDAR.
    `placement` is the index of the placement of each one's object, -1 without an object; None where objects are as
    recorded."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]
    sh0: Float[Tensor, "n 1 3"]
    shN: Float[Tensor, "n k_less_1 3"]
    velocities: Float[Tensor, "n 3"] | None = None
    lidar_logits: Float[Tensor, "n 4 2"] | None = None
    placement: Int[Tensor, " n"] | None = None

    @classmethod
    def of(
        cls, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Float[Tensor, "n k 3"]
    ) -> "Gaussians":
        """From the coefficients of all degrees in one tensor."""
        return cls(means, quats, scales, opacities, sh[:, :1], sh[:, 1:])

    @property
    def sh(self) -> Float[Tensor, "n k 3"]:
        """The coefficients of all degrees."""
        return torch.cat([self.sh0, self.shN], dim=1)

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, chosen: Bool[Tensor, " n"] | Int[Tensor, " m"] | slice) -> "Gaussians":
        """A subset, by mask, indices or slice."""
        return Gaussians(**{name: values[chosen] for name, values in self.tensors.items()})

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Its tensors by field name, without those that are None."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def sh_degree(self) -> int:
        """The degree of the spherical harmonics: k = (degree + 1)² coefficients."""
        return math.isqrt(1 + self.shN.shape[1]) - 1


def recolored(gaussians: Gaussians, matrix: Float[Tensor, "3 3"], chosen: Bool[Tensor, " n"]) -> Gaussians:
    """The same Gaussians with the RGB colours of the `chosen` mapped by a matrix. Does not wait for the device.

    A colour is 0.5 plus the sum of its harmonics: the constant passes through the matrix, too.
    """
    constant = 0.5 * (matrix.sum(dim=1) - 1.0) / SH_C0
    rows = chosen[:, None, None]
    sh0 = torch.where(rows, gaussians.sh0 @ matrix.T + constant, gaussians.sh0)
    return replace(gaussians, sh0=sh0, shN=torch.where(rows, gaussians.shN @ matrix.T, gaussians.shN))


def concatenate(sets: Sequence[Gaussians]) -> Gaussians:
    """Several sets as one, in order, with the highest SH degree of them; a single set is returned unchanged."""
    if len(sets) == 1:
        return sets[0]
    degree = max(s.sh_degree for s in sets)
    sets = _alike([with_sh_degree(s, degree) for s in sets])
    shared = [name for name in sets[0].tensors if all(name in s.tensors for s in sets)]
    return Gaussians(**{name: torch.cat([s.tensors[name] for s in sets]) for name in shared})


def with_sh_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The same Gaussians with spherical harmonics of at least this degree: coefficients that they lack are 0."""
    lacking = (degree + 1) ** 2 - 1 - gaussians.shN.shape[1]
    return gaussians if lacking <= 0 else replace(gaussians, shN=F.pad(gaussians.shN, (0, 0, 0, lacking)))


def concatenate_shapes(sets: Sequence[Gaussians]) -> Gaussians:
    """Several sets as one, as `concatenate`, with geometry, opacity and velocities alone."""
    tensors = [own.tensors for own in _alike(sets)]
    names = [name for name in ("means", "quats", "scales", "opacities", "velocities") if name in tensors[0]]
    joined = {n: torch.cat([own[n] for own in tensors]) if len(sets) > 1 else tensors[0][n] for n in names}
    velocities = joined.pop("velocities", None)
    return Gaussians(*joined.values(), *no_colors(joined["means"]), velocities)


def _alike(sets: Sequence[Gaussians]) -> Sequence[Gaussians]:
    """The same sets, with velocities of 0 and placements of -1 where others have some."""
    some = {name for own in sets for name in own.tensors}
    for name, missing in (("velocities", torch.zeros_like), ("placement", _unplaced)):
        if name in some:
            sets = [own if name in own.tensors else replace(own, **{name: missing(own.means)}) for own in sets]
    return sets


def _unplaced(means: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    return means.new_full((len(means),), -1, dtype=torch.long)


class GaussianSets(tuple[Gaussians, ...]):
    """Sets of Gaussians, one after the other."""

    @cached_property
    def shapes(self) -> Gaussians:
        """All of them as one set, as `concatenate_shapes`. Computed at the first access: without gradient if that is
        within `torch.no_grad`."""
        return concatenate_shapes(self)

    @property
    def are_apart(self) -> bool:
        """Whether `shapes`, a copy of all of them, has not been computed."""
        return "shapes" not in self.__dict__


def no_colors(means: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 1 3"], Float[Tensor, "n 0 3"]]:
    """Coefficients `sh0` and `shN` that are 0, of degree 0, for sensors that see no colours: copying the coefficients
    of a million Gaussians takes time."""
    black = means.new_zeros(1, 1, 3).expand(len(means), 1, 3)
    return black, black[:, :0]
