"""Gaussians where the cameras drove are faded, and no others."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers.samples import sampled

from drivesplat.kernels.road_distance import Road
from drivesplat.kernels.sparse_grid import SparseGrid
from drivesplat.model.background import Background
from drivesplat.settings.train import DefaultSettings, GaussianSettings, McmcSettings, RoadSettings
from drivesplat.training.floaters import LARGEST_STEP, EmptySpace, SensorPath, fade_floaters, near_path, sensor_path
from drivesplat.training.road import driven_road


def distance_to_segment(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """By dense sampling of the segment."""
    samples = start + np.linspace(0.0, 1.0, 2001)[:, None] * (end - start)
    return float(np.linalg.norm(samples - point, axis=1).min())


@pytest.mark.parametrize("radius", [0.6, 1.0, 2.5])
def test_near_is_nearer_than_the_radius_to_any_segment(radius):
    rng = np.random.default_rng(0)
    points, starts, ends = rng.uniform(-4, 4, (60, 3)), rng.uniform(-3, 3, (5, 3)), rng.uniform(-3, 3, (5, 3))
    ends[2] = starts[2]
    distances = np.array([min(distance_to_segment(p, a, b) for a, b in zip(starts, ends, strict=True)) for p in points])
    assert np.abs(distances - radius).min() > 1e-3, "no point may lie where sampling cannot tell"
    near = near_path(*(torch.from_numpy(x).float() for x in (points, starts, ends)), radius)
    np.testing.assert_array_equal(near.numpy(), distances < radius)
    assert near.any() and not near.all()


def test_a_path_joins_consecutive_positions_unless_they_are_far_apart():
    """A lone position is a path, too."""
    centers = torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [6.0 + LARGEST_STEP, 0.0, 0.0]])
    points = torch.tensor([[2.5, 0.2, 0.0], [8.0, 0.0, 0.0], [LARGEST_STEP + 6.2, 0.0, 0.0]])
    assert near_path(points, *sensor_path(centers), 0.5).tolist() == [True, False, True]
    assert near_path(points, *sensor_path(points[:1]), 0.5).tolist() == [True, False, False]


@pytest.mark.parametrize("radius", [0.05, 1.0, 4.0])
def test_cells_around_a_path_hold_all_that_is_near(radius):
    """The points lie around a path whose positions are up to 20 m apart, many of them on its border."""
    rng = np.random.default_rng(1)
    centers = np.array([1000.0, -2000.0, 30.0]) + rng.uniform(-12, 12, (30, 3)).cumsum(axis=0)
    at, towards = centers[rng.integers(0, 30, 20_000)], rng.normal(size=(20_000, 3))
    distances = radius * rng.choice([0.3, 0.999, 1.001, 1.5], 20_000) / np.linalg.norm(towards, axis=1)
    along = rng.uniform(-0.2, 1.2, (20_000, 1)) * rng.uniform(-12, 12, (20_000, 3))
    points = torch.from_numpy(np.concatenate([at + distances[:, None] * towards, at + along])).float()
    centers = torch.from_numpy(centers).float()
    held = SensorPath.of(centers, radius).holds(points)
    assert torch.equal(held, near_path(points, *sensor_path(centers), radius))
    assert held.any() and not held.all()


def test_only_floaters_near_the_path_fade_and_the_rest_stays():
    """Their centres decide, however large Gaussians are. Faded ones are under what the strategies take for dead, fading
    never brightens, and parameters still learn."""
    positions = np.array([[0.0, 0.3, 0.0], [2.0, 0.0, 0.5], [2.0, 3.0, 0.0], [9.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    part = Background.from_points(positions, np.full((5, 3), 0.5), GaussianSettings(init_opacity=0.6), 1.0)
    with torch.no_grad():
        part.params["scales"][3] += 5.0
        part.params["opacities"][4] = -30.0
    before, parameter = {name: value.detach().clone() for name, value in part.params.items()}, part.params["opacities"]
    fade_floaters(part, EmptySpace(SensorPath.of(torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]), 1.0)))
    opacities = sampled(part, 0.0).opacities.detach()
    assert (opacities[:2] < min(1e-3, McmcSettings().min_opacity, DefaultSettings().prune_opacity)).all()
    torch.testing.assert_close(opacities[2:4], torch.tensor([0.6, 0.6]))
    assert float(parameter.detach()[4]) == -30.0
    assert part.params["opacities"] is parameter and parameter.requires_grad and parameter.is_leaf
    for name in before.keys() - {"opacities"}:
        assert torch.equal(part.params[name], before[name])


def test_gaussians_fade_that_the_road_hides():
    """Those `reach` to 5 m below it, and not where there is no road. It rises by 10 % along x."""
    normal = F.normalize(torch.tensor([[-0.1, 0.0, 1.0]]), dim=1)
    cells = SparseGrid.from_numpy(np.zeros(2), 10.0, np.array([1, 1]), np.array([0]))
    road = Road(cells, normal, torch.zeros(1), torch.ones(1), 0.3)
    positions = np.array(
        [[8.0, 5.0, 0.4], [8.0, 5.0, 0.6], [1.0, 1.0, -4.0], [8.0, 5.0, 3.0], [-1.0, 5.0, -4.0], [5.0, 5.0, -6.0]]
    )
    part = Background.from_points(positions, np.full((6, 3), 0.5), GaussianSettings(init_opacity=0.6), 1.0)
    fade_floaters(part, EmptySpace(road=road))
    assert (sampled(part, 0.0).opacities.detach() < 1e-3).nonzero()[:, 0].tolist() == [0, 2]


def test_nothing_is_known_to_be_empty_without_a_radius_and_a_road():
    assert not EmptySpace().known and EmptySpace(SensorPath.of(torch.zeros(1, 3), 1.0)).known
    assert EmptySpace(road=driven_road(np.eye(4)[None], RoadSettings())).known
