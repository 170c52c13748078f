"""Selection of the Gaussians with the largest coverage, for programs that cannot show all.

Coverage is opacity times the area of the largest cross-section, which is the product of the two largest scales up to a
constant. The area is limited to MAX_AREA times its median. Without the limit the few Gaussians that are metres wide
(floaters, sky, far facades), with areas up to a million times the median, would always be selected; with it they are
selected if they are opaque. LightGaussian (Fan et al. 2023) limits volume for the same reason, at its 90th percentile;
the median is robust even if more than a tenth of the Gaussians are huge.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.export.trained_parts import SampledGroup
from drivesplat.model.gaussians import Gaussians, concatenate

MAX_AREA = 10.0
"""The limit of the area, in medians."""


def coverage(gaussians: Gaussians) -> Float[Tensor, " n"]:
    """The coverage of each Gaussian, in square metres up to a constant."""
    areas = gaussians.scales.topk(2, dim=-1).values.prod(dim=-1)
    return gaussians.opacities * areas.clamp_max(MAX_AREA * areas.median())


def largest_coverage(gaussians: Gaussians, count: int) -> Bool[Tensor, " n"]:
    """The mask of the `count` Gaussians with the largest coverage (or of all); the first among equal ones."""
    kept = torch.zeros(len(gaussians), dtype=torch.bool)
    if len(gaussians):
        kept[torch.argsort(coverage(gaussians), descending=True, stable=True)[:count]] = True
    return kept


def thinned_groups(groups: Mapping[str, SampledGroup], count: int) -> dict[str, SampledGroup]:
    """The groups with their share of the `count` Gaussians with the largest coverage, absent objects included."""
    sets = [group.gaussians for group in groups.values()]
    kept = largest_coverage(concatenate(sets), count).split([len(gaussians) for gaussians in sets])
    return {name: group.of_rows(chosen) for (name, group), chosen in zip(groups.items(), kept, strict=True)}
