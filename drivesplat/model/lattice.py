"""Free-form deformation of objects: displacements and rotations at the nodes of a lattice in each object's box, with
trilinear interpolation between them (Sederberg and Parry, SIGGRAPH 1986, with linear in place of Bernstein bases)."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.constants import constant
from drivesplat.kernels.placement import of_owners
from drivesplat.settings.deformable import LatticeSettings


class Deformation(NamedTuple):
    """What n Gaussians are moved by in the frames of their objects: `shifts` in metres, and `turns`, rotation vectors
    halved (radians): the rotation of a turn t is the normalised quaternion (1, t)."""

    shifts: Float[Tensor, "n 3"]
    turns: Float[Tensor, "n 3"]


@dataclass(frozen=True)
class Undeformed:
    """n Gaussians of a objects: their centres (metres, in the frames of their objects), the object of each as index and
    as one-hot matrix, and half the size (metres) of the objects' boxes, enlarged by the margin."""

    means: Float[Tensor, "n 3"]
    owner: Int[Tensor, " n"]
    owns: Float[Tensor, "n a"]
    reach: Float[Tensor, "a 3"]


class Corners(NamedTuple):
    """The eight nodes around each of n points: their numbers in the lattices of all objects, and their weights."""

    nodes: Int[Tensor, "n 8"]
    weights: Float[Tensor, "n 8"]


@dataclass(frozen=True)
class Lattice:
    """A lattice for each of a objects, whose `nodes` (a, k, x, y, z, 6) hold the displacements (metres) and halved
    rotation vectors (radians) of the nodes for each of k functions of phase and time. The penalty of size rises with
    their `orders` (k,)."""

    settings: LatticeSettings
    orders: Float[np.ndarray, " k"]

    def initial(self, count: int) -> Float[Tensor, "a k x y z 6"]:
        """The nodes of `count` objects, which deform nothing."""
        return torch.zeros(count, len(self.orders), *self.settings.nodes, 6)

    def deformation(
        self, nodes: Float[Tensor, "a k x y z 6"], gaussians: Undeformed, basis: Float[Tensor, "a k"]
    ) -> Deformation:
        """The deformation where the k functions of each object have the values `basis`."""
        around = corners(gaussians, self.settings.nodes)
        at_nodes = torch.einsum("ak,akm->am", basis, nodes.flatten(2)).reshape(-1, 6)
        chosen = at_nodes.index_select(0, around.nodes.flatten())  # its gradient is faster than that of indexing
        values = (around.weights[..., None] * chosen.reshape(-1, 8, 6)).sum(dim=1)
        return Deformation(values[:, :3], values[:, 3:])

    def penalties(self, nodes: Float[Tensor, "a k x y z 6"]) -> dict[str, Float[Tensor, ""]]:
        """Weighted terms of the training loss, by name."""
        own = self.settings
        scaled = (nodes.flatten(2) * constant(tuple(self.orders.tolist()), nodes.device)[:, None]).flatten()
        values = max(1, nodes.numel() // len(self.orders))
        return {
            "lattice_size": own.l2_weight / values * scaled.dot(scaled),
            "lattice_roughness": own.smoothness_weight * roughness(nodes),
        }


def corners(gaussians: Undeformed, nodes: tuple[int, int, int]) -> Corners:
    """The nodes around the centres of Gaussians. Lattices of `nodes` along x, y and z fill the boxes of the objects;
    centres outside count as on the surface. The weights have a gradient for the centres."""
    device, layer = gaussians.means.device, nodes[1] * nodes[2]
    in_box = (gaussians.means / of_owners(gaussians.reach, gaussians.owns)).clamp(-1.0, 1.0)
    along = (in_box + 1.0) * constant(tuple(0.5 * (count - 1) for count in nodes), device)
    first = along.detach().floor().minimum(constant(tuple(count - 2.0 for count in nodes), device))
    after = along - first
    x, y, z = torch.stack([1.0 - after, after], dim=1).unbind(dim=2)  # (n, 2) each
    weights = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)
    lowest = (first * constant((layer, nodes[2], 1), device)).sum(dim=1).long() + gaussians.owner * (nodes[0] * layer)
    around = tuple(i * layer + j * nodes[2] + k for i in (0, 1) for j in (0, 1) for k in (0, 1))
    return Corners(lowest[:, None] + constant(around, device).long(), weights)


def roughness(nodes: Float[Tensor, "a k x y z 6"]) -> Float[Tensor, ""]:
    """The mean squared difference between neighbouring nodes, added over the axes and the k functions."""
    return _Roughness.apply(nodes)


class _Roughness(torch.autograd.Function):
    """A quadratic form, whose gradient is computed with it: a fourth of the tensor operations that autograd takes."""

    @staticmethod
    def forward(ctx: Any, nodes: Tensor) -> Tensor:
        pulls = torch.zeros_like(nodes)
        for axis in (2, 3, 4):
            steps = nodes.diff(dim=axis)
            count, each = steps.shape[axis], nodes.shape[1] / max(1, steps.numel())
            pulls.narrow(axis, 1, count).add_(steps, alpha=each)
            pulls.narrow(axis, 0, count).sub_(steps, alpha=each)
        ctx.save_for_backward(pulls)
        return nodes.flatten().dot(pulls.flatten())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, above: Tensor) -> Tensor:
        (pulls,) = ctx.saved_tensors
        return 2.0 * above * pulls
