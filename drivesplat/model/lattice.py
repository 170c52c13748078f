"""Free-form deformation of objects: displacements and rotations at the nodes of a lattice in each object's box, with
trilinear interpolation between them (Sederberg and Parry, SIGGRAPH 1986, with linear in place of Bernstein bases)."""

from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.placement import of_owners


class Deformation(NamedTuple):
    """What n Gaussians are moved by in the frames of their objects: `shifts` in metres, and `turns`, rotation vectors
    halved (radians): the rotation of a turn t is the normalised quaternion (1, t)."""

    shifts: Float[Tensor, "n 3"]
    turns: Float[Tensor, "n 3"]


class Corners(NamedTuple):
    """The eight nodes around each of n points: their numbers in the lattices of all objects, and their weights."""

    nodes: Int[Tensor, "n 8"]
    weights: Float[Tensor, "n 8"]


def corners(
    means: Float[Tensor, "n 3"],
    owner: Int[Tensor, " n"],
    owns: Float[Tensor, "n a"],
    reach: Float[Tensor, "a 3"],
    nodes: tuple[int, int, int],
) -> Corners:
    """The nodes around the points `means` (metres, in the frames of their objects). Lattices of `nodes` along x, y and
    z fill boxes that extend by `reach` (metres) from their centres; points outside count as on the surface. The weights
    have a gradient for `means`."""
    counts = torch.tensor(nodes, device=means.device) if not means.is_cuda else _counts(nodes, means)
    last = (counts - 1).to(means.dtype)
    place = (0.5 * (means / of_owners(reach, owns)).clamp(-1.0, 1.0) + 0.5) * last
    first = place.detach().floor().minimum(last - 1.0).clamp(min=0.0)
    after = place - first
    sides = torch.stack([1.0 - after, after], dim=1)  # (n, 2, 3)
    start = first.long()
    found, weights = [], []
    for x, y, z in product((0, 1), repeat=3):
        index = ((start[:, 0] + x) * nodes[1] + start[:, 1] + y) * nodes[2] + start[:, 2] + z
        found.append(owner * (nodes[0] * nodes[1] * nodes[2]) + index)
        weights.append(sides[:, x, 0] * sides[:, y, 1] * sides[:, z, 2])
    return Corners(torch.stack(found, dim=1), torch.stack(weights, dim=1))


def _counts(nodes: tuple[int, int, int], like: Tensor) -> Tensor:
    return torch.stack([torch.full((), count, device=like.device) for count in nodes])  # no copy from the host


def deformation(
    coefficients: Float[Tensor, "a k x y z 6"], basis: Float[Tensor, "a k"], around: Corners
) -> Deformation:
    """The deformation of points `around` which nodes lie: the k coefficients of each node summed with the weights
    `basis` of its object."""
    at_nodes = torch.einsum("ak,akm->am", basis, coefficients.flatten(2)).reshape(-1, 6)
    moved = (around.weights[..., None] * at_nodes[around.nodes]).sum(dim=1)
    return Deformation(moved[:, :3], moved[:, 3:])


def roughness(coefficients: Float[Tensor, "a k x y z 6"]) -> Float[Tensor, " k"]:
    """The mean squared difference between neighbouring nodes for each of the k coefficients."""
    return sum(  # type: ignore[return-value]
        coefficients.diff(dim=axis).square().mean(dim=(0, 2, 3, 4, 5)) for axis in (2, 3, 4)
    )
