"""The route of the ego vehicle through the grid: its loops, its lane, its speed."""

from itertools import islice, pairwise

import numpy as np
import pytest

from drivesplat.settings.world import WorldRouteSettings
from drivesplat.world.layout import LANE, ROAD, SIDEWALK
from drivesplat.world.route.grid import FORWARD, CityBlock, hidden
from drivesplat.world.route.path import FASTER, SIDEWARD, SLOWER, LanePath, turns_of
from drivesplat.world.route.tour import APPROACH, ego_path, loop_headings, tour
from drivesplat.world.route.traffic import ego_rectangles

ROUTE = WorldRouteSettings()
SECONDS = np.arange(0.0, 240.0, 0.1)


@pytest.fixture(scope="module")
def path() -> LanePath:
    return ego_path(ROUTE, 0, 240.0)


def corners(rectangles: np.ndarray) -> np.ndarray:
    """Corners (n, 4, 2) of ground rectangles (n, 3, 2)."""
    center, forward, left = rectangles[:, 0], rectangles[:, 1], rectangles[:, 2]
    return np.stack([center + a * forward + b * left for a in (-1, 1) for b in (-1, 1)], axis=1)


def off_the_road(points: np.ndarray, block_m: float) -> np.ndarray:
    """Metres (...,) by which points (..., 2) are beside the road, whose corners at crossings are round."""
    from_street = np.abs((points + block_m / 2) % block_m - block_m / 2)
    beside = from_street.min(axis=-1) - ROAD
    at_crossing = (from_street < SIDEWALK).all(axis=-1)
    corner = (SIDEWALK - ROAD) - np.linalg.norm(SIDEWALK - from_street, axis=-1)
    return np.where(at_crossing, np.minimum(beside, corner), beside)


@pytest.mark.parametrize("blocks", [4, 6, 8, 12, 30])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_loops_close_without_crossing_themselves_and_turn_to_both_sides(blocks, seed):
    for closure in ("same", "opposite"):
        route, random = WorldRouteSettings(loop_blocks=blocks, closure=closure), np.random.default_rng(seed)
        headings = loop_headings(route, 1, random)
        around = headings if closure == "same" else headings[1:]
        assert len(around) == blocks and headings[0] == 1
        places = np.cumsum(FORWARD[around], axis=0)
        assert not places[-1].any() and len(np.unique(places, axis=0)) == blocks
        assert turns_of([*headings, 1 if closure == "same" else 3])[-1] in (-1, 0, 1)
        assert (set(turns_of(around)) >= {-1, 1}) == (blocks >= 8)


@pytest.mark.parametrize("closure", ["same", "opposite"])
def test_the_route_passes_its_first_street_again_minutes_later(closure):
    route = WorldRouteSettings(closure=closure)
    path = ego_path(route, 0, 200.0)
    poses = path.poses(SECONDS)
    near = np.linalg.norm(poses[:, :2, 3] - poses[0, :2, 3], axis=1) < 5.0
    again = SECONDS[near & (SECONDS > 30.0)]
    assert again.min() == pytest.approx(130.0, abs=50.0)
    facing = path.poses(again[:1])[0, :2, 0] @ poses[0, :2, 0]
    assert facing == pytest.approx(1.0 if closure == "same" else -1.0, abs=0.05)
    beside = np.abs(poses[near & (SECONDS > 30.0)][:, :2, 3] - poses[0, :2, 3])[:, 1].min()
    assert (beside < 0.3) if closure == "same" else (3.0 < beside < 4.0), "each in its own lane"


def test_a_longer_route_begins_as_a_shorter_one(path):
    longer = ego_path(ROUTE, 0, 3600.0)
    seconds = np.arange(-10.0, 240.0, 0.37)
    np.testing.assert_array_equal(longer.poses(seconds), path.poses(seconds))
    assert ego_path(ROUTE, 1, 240.0).headings != path.headings


def test_the_vehicle_stays_in_its_lane_and_in_turns_on_the_road(path):
    places = corners(ego_rectangles(path, SECONDS))
    assert off_the_road(places, ROUTE.block_m).max() < -0.5
    along = path.distances(SECONDS)
    straight = np.abs(path.curvature(along)) < 1e-9
    index = np.array([path.street_at(float(a)) for a in along])
    headings = np.array(path.headings)[index]
    axis = np.array([path.crossing(int(i)) for i in index]) * ROUTE.block_m
    left = np.stack([-FORWARD[headings][:, 1], FORWARD[headings][:, 0]], axis=-1)
    aside = np.einsum("nki,ni->nk", places - axis[:, None], left)[straight]
    assert straight.mean() > 0.6 and aside.min() > -LANE and aside.max() < -0.5, "on the right, clear of the middle"


def test_the_path_is_as_long_as_it_says_and_faces_where_it_leads():
    path = LanePath((2, -1), (0, 1, 1, 2, 1, 0, 3), 84.0, 12.0, sway=0.1)
    along = np.arange(0.0, path.length, 0.05)
    places, direction = path.places(along)
    steps = np.diff(places, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.05, rtol=0.02)
    direction = np.unwrap(direction)
    middle = (direction[1:] + direction[:-1]) / 2
    off = np.angle(np.exp(1j * (np.arctan2(steps[:, 1], steps[:, 0]) - middle)))
    assert np.abs(off).max() < 2e-3
    bends = np.diff(direction) / 0.05
    sway = 0.1 * (2 * np.pi / 90.0) ** 2
    np.testing.assert_allclose(bends, path.curvature((along[1:] + along[:-1]) / 2), atol=1.5 * sway)
    np.testing.assert_allclose(places[0], [2 * 84.0, -84.0 - 1.75], atol=1e-9)
    np.testing.assert_allclose(path.places(np.array([path.along_at(2, 40.0)]))[0][0, 1], 40.0, atol=0.1)


def test_the_speed_keeps_to_limits_of_acceleration(path):
    seconds = np.arange(0.0, 240.0, 0.02)
    along = path.distances(seconds)
    speed = np.diff(along) / 0.02
    assert speed.max() == pytest.approx(ROUTE.speed, abs=0.01) and 3.0 < speed.min() < 6.0
    acceleration = np.diff(speed) / 0.02
    assert acceleration.min() > -1.05 * SLOWER and acceleration.max() < 1.05 * FASTER
    sideward = speed**2 * np.abs(path.curvature((along[1:] + along[:-1]) / 2))
    assert sideward.max() < 1.1 * SIDEWARD
    for along in (0.3, 100.0, 700.0):
        assert path.distances(np.array([path.seconds(along)]))[0] == pytest.approx(along, abs=0.01)


def test_paths_do_not_turn_round():
    headings = [*islice(tour(WorldRouteSettings(loop_blocks=8), 5), 400)]
    assert headings[:APPROACH] == [0] * APPROACH
    assert all((b - a) % 4 != 2 for a, b in pairwise(headings))
    with pytest.raises(ValueError, match="turn round"):
        turns_of([0, 2])


def test_streets_are_the_same_from_both_ends():
    assert CityBlock.between((3, 4), 2) == CityBlock.between((2, 4), 0) == CityBlock((2, 4), 0)
    assert CityBlock.between((3, 4), 3) == CityBlock.between((3, 3), 1) == CityBlock((3, 3), 1)


def test_houses_hide_what_is_around_the_corner_and_nothing_along_the_street():
    viewer = np.tile([30.0, -2.0], (4, 1))
    points = np.array([[400.0, 2.0], [86.0, 60.0], [82.0, 8.0], [45.0, 9.0]])
    assert hidden(viewer, points, 84.0).tolist() == [False, True, False, False]
