"""Transforms the Gaussians of rigid objects from object to world coordinates."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from drivesplat.kernels import triton_support
from drivesplat.kernels.quaternions import left_factor, rotation_matrix


class LocalGaussians(NamedTuple):
    """The parameters of n Gaussians in the frames of their objects: `means` (metres), `quats` (w, x, y, z) of any
    length, logarithms of `scales` (metres) and logits of `opacities`."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]


class ObjectPoses(NamedTuple):
    """Poses of a objects, object to world: unit `quats` w, x, y, z and `translations` (metres); `sizes`, the factors by
    which they are enlarged; `presence`, 1 or 0."""

    quats: Float[Tensor, "a 4"]
    translations: Float[Tensor, "a 3"]
    sizes: Float[Tensor, " a"]
    presence: Float[Tensor, " a"]


def place(
    gaussians: LocalGaussians, objects: ObjectPoses, owner: Int[Tensor, " n"], owns: Float[Tensor, "n a"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"], Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Means (metres), unit quaternions, scales (metres) and opacities in the world.

    `owner` is the object of every Gaussian, `owns` the same as a one-hot matrix. Gradients reach the Gaussians and the
    objects' quaternions and translations.
    """
    if triton_support.usable_for(gaussians.means):
        from drivesplat.kernels.triton.placement import Placement

        return Placement.apply(*gaussians, *objects, owner, owns)
    sizes = of_owners(objects.sizes, owns)[:, None]
    rotated = (of_owners(rotation_matrix(objects.quats), owns) @ (sizes * gaussians.means)[..., None])[..., 0]
    return (
        rotated + of_owners(objects.translations, owns),
        (of_owners(left_factor(objects.quats), owns) @ normalize(gaussians.quats, dim=-1)[..., None])[..., 0],
        sizes * torch.exp(gaussians.scales),
        torch.sigmoid(gaussians.opacities) * of_owners(objects.presence, owns),
    )


def mirrored(gaussians: LocalGaussians, side: Float[Tensor, " n"]) -> LocalGaussians:
    """Gaussians in the frames of their objects, reflected about the plane y = 0 where `side` is -1, and unchanged where
    it is 1."""
    same = torch.ones_like(side)
    means = gaussians.means * torch.stack([same, side, same], dim=1)
    return gaussians._replace(means=means, quats=gaussians.quats * torch.stack([same, side, same, side], dim=1))


def of_owners(values: Float[Tensor, " a *v"], owns: Float[Tensor, "n a"]) -> Float[Tensor, " n *v"]:
    """The values of every Gaussian's object. The product with the one-hot matrix is exact, and its gradient is a matrix
    product too, while that of indexing is a sum row by row."""
    return (owns.to(values.dtype) @ values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])
