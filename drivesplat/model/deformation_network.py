"""A network that deforms objects, shared by all of them, with an embedding for each: the deformable nodes of OmniRe
(Chen et al. 2024, arXiv 2408.16760), with phase and time in place of time alone."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.placement import of_owners
from drivesplat.model.deformation import Deformation, Field, Undeformed
from drivesplat.settings.deformable import NetworkSettings


@dataclass(frozen=True)
class NetworkField(Field):
    """Layers `weight{i}` and `bias{i}` from the encoded place in the box, the `embedding` (a, e) of its object and k
    functions of phase and time to shift and turn."""

    settings: NetworkSettings
    functions: int

    def initial(self, count: int) -> dict[str, Tensor]:
        own = self.settings
        generator = torch.Generator().manual_seed(0)
        sizes = [3 + 6 * own.frequencies + own.embedding + self.functions, *[own.width] * own.layers, 6]
        made = {"embedding": 0.1 * torch.randn(count, own.embedding, generator=generator)}
        for i, (inputs, outputs) in enumerate(pairwise(sizes)):
            last = i == own.layers
            spread = 0.0 if last else math.sqrt(2.0 / inputs)  # He et al. 2015; the last layer deforms nothing
            made[f"weight{i}"] = spread * torch.randn(inputs, outputs, generator=generator)
            made[f"bias{i}"] = torch.zeros(outputs)
        return made

    def deformation(
        self, parameters: Mapping[str, Tensor], gaussians: Undeformed, basis: Float[Tensor, "a k"]
    ) -> Deformation:
        places = gaussians.means / of_owners(gaussians.reach, gaussians.owns)
        of_objects = of_owners(torch.cat([parameters["embedding"], basis], dim=1), gaussians.owns)
        values = torch.cat([encoded(places, self.settings.frequencies), of_objects], dim=1)
        for i in range(self.settings.layers):
            values = torch.relu(values @ parameters[f"weight{i}"] + parameters[f"bias{i}"])
        last = self.settings.layers
        return Deformation.of(values @ parameters[f"weight{last}"] + parameters[f"bias{last}"])

    def penalties(self, parameters: Mapping[str, Tensor]) -> dict[str, Float[Tensor, ""]]:
        return {}

    @property
    def learning_rate(self) -> float:
        return self.settings.learning_rate


def encoded(places: Float[Tensor, "n 3"], frequencies: int) -> Float[Tensor, "n c"]:
    """Places, and sine and cosine of their multiples by powers of two times pi (NeRF, Mildenhall et al. 2020)."""
    turned = [f(2.0**i * math.pi * places) for i in range(frequencies) for f in (torch.sin, torch.cos)]
    return torch.cat([places, *turned], dim=1)
