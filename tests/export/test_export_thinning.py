"""Fewer Gaussians for programs that cannot show all: those stay that cover most, among all groups together."""

import dataclasses

import pytest
import torch
from helpers.hand_made_traffic import some_gaussians

from drivesplat.export.thinning import largest_coverage, thinned_groups
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.model.gaussians import Gaussians


def gaussians_of(scales: list[list[float]], opacities: list[float]) -> Gaussians:
    count = len(scales)
    means = torch.arange(float(count))[:, None].repeat(1, 3)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    return Gaussians.of(means, quats, torch.tensor(scales), torch.tensor(opacities), torch.zeros(count, 1, 3))


def thinned(gaussians: Gaussians, count: int) -> Gaussians:
    return gaussians[largest_coverage(gaussians, count)]


def places(gaussians: Gaussians) -> list[int]:
    """Which of `gaussians_of` these are."""
    return gaussians.means[:, 0].int().tolist()


@pytest.mark.parametrize(
    ("scales", "opacities", "kept"),
    [
        pytest.param([[1, 1, 1]] * 4, [0.2, 0.9, 0.1, 0.8], [1, 3], id="the opaque, in their order"),
        pytest.param([[0.5] * 3, [0.4] * 3, [0.6] * 3, [0.7] * 3], [0.5] * 4, [2, 3], id="the large"),
        pytest.param([[1, 1, 0.1], [3, 0.2, 0.2], [0.9] * 3, [0.1, 1.2, 1]], [0.5] * 4, [0, 3], id="by cross-section"),
        pytest.param([[1, 1, 1]] * 4, [0.5] * 4, [0, 1], id="the first among equals"),
    ],
)
def test_gaussians_with_the_largest_coverage_are_kept(scales, opacities, kept):
    assert places(thinned(gaussians_of([[float(s) for s in row] for row in scales], opacities), 2)) == kept


def test_large_faint_gaussians_do_not_displace_sharp_ones():
    """40 giants of 100 m and an opacity of 0.05 among 60 opaque Gaussians of 5 cm."""
    crowd = gaussians_of([[100.0] * 3] * 40 + [[0.05] * 3] * 60, [0.05] * 40 + [0.9] * 60)
    assert places(thinned(crowd, 60)) == list(range(40, 100))


def test_a_large_opaque_gaussian_is_kept():
    assert places(thinned(gaussians_of([[0.05] * 3] * 9 + [[5.0] * 3], [0.9] * 10), 1)) == [9]


@pytest.mark.parametrize("count", [30, 31, 10_000])
def test_a_sufficient_budget_changes_nothing(count):
    shown = some_gaussians(30, 1, seed=0)
    for name, values in thinned(shown, count).tensors.items():
        assert torch.equal(values, shown.tensors[name])


def test_groups_share_the_budget_by_coverage():
    """Of several degrees of spherical harmonics, too, which stay as they are."""
    one, other = (gaussians_of([[1.0] * 3] * 3, opacities) for opacities in ([0.9, 0.1, 0.8], [0.2, 0.7, 0.3]))
    other = dataclasses.replace(other, shN=torch.zeros(3, 3, 3))
    kept = thinned_groups({"a": SampledGroup(one), "b": SampledGroup(other)}, 3)
    assert {name: places(group.gaussians) for name, group in kept.items()} == {"a": [0, 2], "b": [1]}
    assert [group.gaussians.sh_degree for group in kept.values()] == [0, 1]
    nothing = {"a": SampledGroup(one[torch.zeros(3, dtype=torch.bool)])}
    assert len(thinned_groups(nothing, 3)["a"].gaussians) == 0
