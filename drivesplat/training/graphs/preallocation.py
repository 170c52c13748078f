"""Preallocated rows for Gaussians that densification will add.

With them a part's tensors keep their addresses and sizes while its number of Gaussians grows, so that the CUDA graphs
of iterations stay valid. The opacity and scales of a preallocated row are exactly 0: it is not rendered, receives no
gradient, and is moved neither by Adam nor by the noise of MCMC.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim import Adam

from drivesplat.kernels import gsplat_private
from drivesplat.kernels.mcmc import relocation
from drivesplat.model.part import Part, preallocate

INACTIVE = -1000.0
"""Log scale and opacity logit whose exponential and sigmoid are exactly 0 in single precision."""


@torch.no_grad()
def reserve_rows(part: Part, optimizers: dict[str, Adam], rows: int) -> None:
    """Adds preallocated rows up to `rows` rows in all."""
    more, active = rows - part.row_count, len(part)

    def longer(name: str, values: Tensor) -> nn.Parameter:
        added = values[:1].expand(more, *values.shape[1:])
        if name in ("scales", "opacities"):
            added = torch.full_like(added, INACTIVE)
        return nn.Parameter(torch.cat([values, added]), requires_grad=values.requires_grad)

    def unmoved(_: str, moments: Tensor) -> Tensor:
        return torch.cat([moments, moments.new_zeros(more, *moments.shape[1:])])

    gsplat_private.update_parameters(longer, unmoved, part.params, optimizers)
    preallocate(part, rows - active)


@torch.no_grad()
def release_rows(part: Part, optimizers: dict[str, Adam]) -> None:
    """Drops all preallocated rows."""
    active = len(part)

    def shorter(_: str, values: Tensor) -> nn.Parameter:
        return nn.Parameter(values[:active].clone(), requires_grad=values.requires_grad)

    gsplat_private.update_parameters(shorter, lambda _, moments: moments[:active].clone(), part.params, optimizers)
    preallocate(part, 0)


@torch.no_grad()
def activate(part: Part, count: int, binoms: Float[Tensor, "n_max n_max"], min_opacity: float) -> None:
    """Turns `count` preallocated rows into Gaussians as gsplat's `sample_add` adds new ones: each is a copy of one
    drawn by opacity, and both together look as that one did (Kheradmand et al. 2024, equation 9)."""
    params, active = part.params, len(part)
    opacities, scales = torch.sigmoid(params["opacities"][:active]), torch.exp(params["scales"][:active])
    drawn = gsplat_private.sample_rows(opacities, count)
    times = torch.bincount(drawn)[drawn] + 1
    opacities, scales = relocation(opacities[drawn], scales[drawn], times, binoms)
    most = 1.0 - torch.finfo(torch.float32).eps
    params["opacities"][drawn] = torch.logit(opacities.clamp(min_opacity, most))
    params["scales"][drawn] = torch.log(scales)
    for values in params.values():
        values[active : active + count] = values[drawn]
    preallocate(part, part.preallocated - count)
