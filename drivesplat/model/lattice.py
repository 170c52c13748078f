"""Free-form deformation of objects: displacements and rotations at the nodes of a lattice in each object's box, with
trilinear interpolation between them (Sederberg and Parry, SIGGRAPH 1986, with linear in place of Bernstein bases)."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.placement import of_owners
from drivesplat.model.deformation import Deformation, Field, Undeformed
from drivesplat.settings.deformable import LatticeSettings


class Corners(NamedTuple):
    """The eight nodes around each of n points: their numbers in the lattices of all objects, and their weights."""

    nodes: Int[Tensor, "n 8"]
    weights: Float[Tensor, "n 8"]


@dataclass(frozen=True)
class LatticeField(Field):
    """A lattice for each object. The parameter `lattice` (a, k, x, y, z, 6) holds the displacements (metres) and halved
    rotation vectors (radians) of the nodes for each of k functions, whose `orders` (k,) the penalty of size rises with.
    """

    settings: LatticeSettings
    orders: Float[np.ndarray, " k"]

    def initial(self, count: int) -> dict[str, Tensor]:
        return {"lattice": torch.zeros(count, len(self.orders), *self.settings.nodes, 6)}

    def deformation(
        self, parameters: Mapping[str, Tensor], gaussians: Undeformed, basis: Float[Tensor, "a k"]
    ) -> Deformation:
        around, nodes = corners(gaussians, self.settings.nodes), parameters["lattice"]
        at_nodes = torch.einsum("ak,akm->am", basis, nodes.flatten(2)).reshape(-1, 6)
        return Deformation.of((around.weights[..., None] * at_nodes[around.nodes]).sum(dim=1))

    def penalties(self, parameters: Mapping[str, Tensor]) -> dict[str, Float[Tensor, ""]]:
        nodes, own = parameters["lattice"], self.settings
        sizes = nodes.square().mean(dim=(0, 2, 3, 4, 5)).unbind()
        weighted = [float(order) ** 2 * size for order, size in zip(self.orders, sizes, strict=True)]
        return {
            "lattice_size": own.size_weight * torch.stack(weighted).sum(),
            "lattice_roughness": own.smoothness_weight * roughness(nodes).sum(),
        }

    @property
    def learning_rate(self) -> float:
        return self.settings.learning_rate


def corners(gaussians: Undeformed, nodes: tuple[int, int, int]) -> Corners:
    """The nodes around the centres of Gaussians. Lattices of `nodes` along x, y and z fill the boxes of the objects;
    centres outside count as on the surface. The weights have a gradient for the centres."""
    places = gaussians.means / of_owners(gaussians.reach, gaussians.owns)
    firsts, sides = [], []
    for axis, count in enumerate(nodes):
        place = (0.5 * places[:, axis].clamp(-1.0, 1.0) + 0.5) * (count - 1)
        first = place.detach().floor().clamp(max=count - 2)
        firsts.append(first.long())
        sides.append((1.0 - (place - first), place - first))
    found, weights = [], []
    for x, y, z in product((0, 1), repeat=3):
        index = ((firsts[0] + x) * nodes[1] + firsts[1] + y) * nodes[2] + firsts[2] + z
        found.append(gaussians.owner * (nodes[0] * nodes[1] * nodes[2]) + index)
        weights.append(sides[0][x] * sides[1][y] * sides[2][z])
    return Corners(torch.stack(found, dim=1), torch.stack(weights, dim=1))


def roughness(nodes: Float[Tensor, "a k x y z 6"]) -> Float[Tensor, " k"]:
    """The mean squared difference between neighbouring nodes for each of the k functions."""
    differences = [nodes.diff(dim=axis).square().mean(dim=(0, 2, 3, 4, 5)) for axis in (2, 3, 4)]
    return torch.stack(differences).sum(dim=0)
