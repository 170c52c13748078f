"""Transforms the Gaussians of rigid objects from object to world coordinates, with spherical harmonics that vary with
time as a Fourier series."""

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


def colors_in_world(
    sh0: Float[Tensor, "n f 1 3"],
    shN: Float[Tensor, "n f k_less_1 3"],
    series: Float[Tensor, "a f"],
    rotations: Float[Tensor, "a k k"],
    owner: Int[Tensor, " n"],
    owns: Float[Tensor, "n a"],
) -> tuple[Float[Tensor, "n 1 3"], Float[Tensor, "n k_less_1 3"]]:
    """The harmonics of n Gaussians in the world, those of degree 0 and those above: `colors_in_object`, mapped by
    `rotations` of their object's harmonics. `owner` is the object of every Gaussian, `owns` the same as a one-hot
    matrix. Gradients reach `sh0` and `shN`."""
    if triton_support.usable_for(sh0):
        from drivesplat.kernels.triton.time_varying_colors import ColorsInWorld

        return ColorsInWorld.apply(sh0, shN, series.contiguous(), rotations.contiguous(), owner)
    sh = colors_in_object(sh0, shN, series, owns)
    turned = of_owners(rotations, owns) @ sh if sh.shape[1] > 1 else sh
    return turned[:, :1], turned[:, 1:]


def colors_in_object(
    sh0: Float[Tensor, "n f 1 3"],
    shN: Float[Tensor, "n f k_less_1 3"],
    series: Float[Tensor, "a f"],
    owns: Float[Tensor, "n a"],
) -> Float[Tensor, "n k 3"]:
    """The harmonics of n Gaussians in their objects' frames: their f Fourier coefficients summed with the weights
    `series` of their object, the first of which is 1."""
    coefficients = torch.cat([sh0, shN], dim=2)
    if coefficients.shape[1] == 1:
        return coefficients[:, 0]
    return (of_owners(series, owns)[:, :, None, None] * coefficients).sum(dim=1)
