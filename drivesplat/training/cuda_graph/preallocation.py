"""Spare rows: room for Gaussians that densification will make.

With them a part's tensors stay where they lie, and as long as they are, while its Gaussians become more, so that what
is recorded of iterations outlives that. A spare row has no opacity and no size, exactly: nothing shows it, no gradient
reaches it, and neither Adam nor MCMC's noise moves it.
"""

import torch
from gsplat.strategy import ops
from jaxtyping import Float
from torch import Tensor, nn

from drivesplat.model.part import Part
from drivesplat.training.optimizers import Optimizers

NOTHING = -1000.0
"""The log of a size and the logit of an opacity of which single precision leaves 0."""


@torch.no_grad()
def reserve(part: Part, optimizers: Optimizers, rows: int) -> None:
    """Adds spare rows up to so many in all."""
    more, there = rows - part.row_count, len(part)

    def longer(name: str, values: Tensor) -> nn.Parameter:
        added = values[:1].expand(more, *values.shape[1:])
        if name in ("scales", "opacities"):
            added = torch.full_like(added, NOTHING)
        return nn.Parameter(torch.cat([values, added]), requires_grad=values.requires_grad)

    def unmoved(_: str, moments: Tensor) -> Tensor:
        return torch.cat([moments, moments.new_zeros(more, *moments.shape[1:])])

    ops._update_param_with_optimizer(longer, unmoved, part.params, optimizers)
    part.spare = rows - there


@torch.no_grad()
def release(part: Part, optimizers: Optimizers) -> None:
    """Drops all spare rows."""
    there = len(part)

    def shorter(_: str, values: Tensor) -> nn.Parameter:
        return nn.Parameter(values[:there].clone(), requires_grad=values.requires_grad)

    ops._update_param_with_optimizer(shorter, lambda _, moments: moments[:there].clone(), part.params, optimizers)
    part.spare = 0


@torch.no_grad()
def wake(part: Part, count: int, binoms: Float[Tensor, "n_max n_max"], min_opacity: float) -> None:
    """Makes Gaussians of so many spare rows, as gsplat's `sample_add` makes new ones: each is a copy of one drawn by
    opacity, and both together look as that one did (Kheradmand et al. 2024, equation 9)."""
    params, there = part.params, len(part)
    opacities, scales = torch.sigmoid(params["opacities"][:there]), torch.exp(params["scales"][:there])
    drawn = ops._multinomial_sample(opacities, count)
    times = torch.bincount(drawn)[drawn] + 1
    opacities, scales = ops.compute_relocation(opacities[drawn], scales[drawn], times, binoms)
    most = 1.0 - torch.finfo(torch.float32).eps
    params["opacities"][drawn] = torch.logit(opacities.clamp(min_opacity, most))
    params["scales"][drawn] = torch.log(scales)
    for values in params.values():
        values[there : there + count] = values[drawn]
    part.spare -= count
