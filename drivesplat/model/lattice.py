"""Free-form deformation of objects: displacements and rotations at the nodes of a lattice in each object's box, with
trilinear interpolation between them (Sederberg and Parry, SIGGRAPH 1986, with linear in place of Bernstein bases)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
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
        chosen = at_nodes.index_select(0, around.nodes.flatten())  # its gradient is faster than that of indexing
        return Deformation.of((around.weights[..., None] * chosen.reshape(-1, 8, 6)).sum(dim=1))

    def penalties(self, parameters: Mapping[str, Tensor]) -> dict[str, Float[Tensor, ""]]:
        nodes, own = parameters["lattice"], self.settings
        sizes = nodes.square().mean(dim=(0, 2, 3, 4, 5))
        return {
            "lattice_size": own.size_weight * (sizes @ _squares(tuple(self.orders.tolist()), sizes.device)),
            "lattice_roughness": own.smoothness_weight * roughness(nodes).sum(),
        }

    @property
    def learning_rate(self) -> float:
        return self.settings.learning_rate


def corners(gaussians: Undeformed, nodes: tuple[int, int, int]) -> Corners:
    """The nodes around the centres of Gaussians. Lattices of `nodes` along x, y and z fill the boxes of the objects;
    centres outside count as on the surface. The weights have a gradient for the centres."""
    places = 0.5 * (gaussians.means / of_owners(gaussians.reach, gaussians.owns)).clamp(-1.0, 1.0) + 0.5
    along = [places[:, axis] * (count - 1) for axis, count in enumerate(nodes)]
    first = [place.detach().floor().clamp(max=count - 2) for place, count in zip(along, nodes, strict=True)]
    x, y, z = (torch.stack([1.0 - (place - low), place - low], dim=1) for place, low in zip(along, first, strict=True))
    weights = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)
    row, layer = nodes[2], nodes[1] * nodes[2]
    lowest = gaussians.owner * (nodes[0] * layer) + (first[0] * layer + first[1] * row + first[2]).long()
    corner = torch.arange(8, device=lowest.device)
    return Corners(lowest[:, None] + corner // 4 * layer + corner // 2 % 2 * row + corner % 2, weights)


@cache
def _squares(orders: tuple[float, ...], device: torch.device) -> Float[Tensor, " k"]:
    return torch.tensor(orders, device=device).square()


def roughness(nodes: Float[Tensor, "a k x y z 6"]) -> Float[Tensor, " k"]:
    """The mean squared difference between neighbouring nodes for each of the k functions."""
    differences = [nodes.diff(dim=axis).square().mean(dim=(0, 2, 3, 4, 5)) for axis in (2, 3, 4)]
    return torch.stack(differences).sum(dim=0)
