"""Fewer Gaussians for programs that cannot show all: those that cover most.

How much a Gaussian covers is its opacity times the area of its largest cross-section, up to a constant the product of
its two largest scales. Area counts up to LARGEST_AREA times the median only. Otherwise the few that are metres wide
(floaters, what stands in for the sky, far facades) would take every place, as they are a million times the size of the
median: with the limit they are kept if they are opaque, and a faint one goes before a sharp, opaque one of median size.
LightGaussian (Fan et al. 2023) limits volume for the same reason, at its 90th percentile; the median also holds where
more than a tenth are huge.
"""

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.export.trained_parts import SampledGroup
from drivesplat.model.gaussians import Gaussians, concatenate

LARGEST_AREA = 10.0
"""The largest area that counts, in medians."""


def coverage(gaussians: Gaussians) -> Float[Tensor, " n"]:
    """How much each of the Gaussians covers, in square metres up to a constant."""
    areas = gaussians.scales.topk(2, dim=-1).values.prod(dim=-1)
    return gaussians.opacities * areas.clamp_max(LARGEST_AREA * areas.median())


def covering_most(gaussians: Gaussians, count: int) -> Bool[Tensor, " n"]:
    """Which `count` of the Gaussians cover most (all, if they are fewer); among equals the first."""
    kept = torch.zeros(len(gaussians), dtype=torch.bool)
    if len(gaussians):
        kept[torch.argsort(coverage(gaussians), descending=True, stable=True)[:count]] = True
    return kept


def thinned(gaussians: Gaussians, count: int) -> Gaussians:
    """The `count` Gaussians that cover most, in their order."""
    return gaussians[covering_most(gaussians, count)]


def thinned_groups(groups: Mapping[str, SampledGroup], count: int) -> dict[str, SampledGroup]:
    """The `count` Gaussians that cover most among all groups together, absent objects included, in their groups."""
    sets = [group.gaussians for group in groups.values()]
    kept = covering_most(concatenate(sets), count).split([len(gaussians) for gaussians in sets])
    return {
        name: replace(group, gaussians=group.gaussians[chosen])
        for (name, group), chosen in zip(groups.items(), kept, strict=True)
    }
