"""Road users along a route: nobody touches anybody, and a longer drive has the same ones."""

from itertools import combinations

import numpy as np
import pytest
from helpers.demo_worlds import world_of
from helpers.ground_rectangles import gaps

from drivesplat.world.route.grid import CityBlock, hidden
from drivesplat.world.route.path import turns_of
from drivesplat.world.route.scenery import StreetScenery
from drivesplat.world.route.tour import ego_path
from drivesplat.world.route.traffic import (
    EXTENTS,
    FAR,
    MAX_LIFE_S,
    RoadUser,
    RoadUsers,
    ego_rectangles,
    rectangles,
)

DURATION = 40.0
WORLD = world_of(route={}, vehicles=4, pedestrians=6, cyclists=2, key_frames=81)
BLOCK = WORLD.route.block_m


def traffic_of(seconds: float) -> RoadUsers:
    return RoadUsers(WORLD, ego_path(WORLD.route, WORLD.random_seed, seconds + 80.0), seconds)


@pytest.fixture(scope="module")
def ego():
    return ego_path(WORLD.route, WORLD.random_seed, 200.0)


@pytest.fixture(scope="module")
def users() -> list[RoadUser]:
    return traffic_of(DURATION).near(0.0, DURATION)


def test_a_longer_drive_has_the_same_road_users(users):
    assert traffic_of(DURATION + 15.0).near(0.0, DURATION) == users


def test_there_are_as_many_as_on_one_street_and_all_kinds(users):
    for second in np.arange(5.0, DURATION, 5.0).tolist():
        present = [user.group for user in users if user.begin <= second <= user.end]
        assert 1 <= present.count("vehicle") <= 3 * WORLD.vehicles
        assert len(present) <= 2.5 * (WORLD.vehicles + WORLD.pedestrians + WORLD.cyclists)
    assert {user.kind for user in users} == set(EXTENTS)
    assert any(set(turns_of(user.path.headings)) & {-1, 1} for user in users), "some turn"


def test_nobody_touches_anybody_at_any_time(users, ego):
    seconds = np.arange(0.0, DURATION, 0.1)
    boxed = {user.name: (rectangles(user, seconds), user.begin, user.end) for user in users}
    boxed["ego"] = ego_rectangles(ego, seconds), -np.inf, np.inf
    for (a, (one, begin, end)), (b, (other, start, stop)) in combinations(boxed.items(), 2):
        both = (seconds >= max(begin, start)) & (seconds <= min(end, stop))
        if both.any():
            assert gaps(one[both], other[both]).min() > 0.0, f"{a} meets {b}"


def test_nobody_touches_a_parked_vehicle(users, ego):
    seconds = np.arange(0.0, DURATION, 0.2)
    moving = [rectangles(user, seconds[(seconds >= user.begin) & (seconds <= user.end)]) for user in users]
    moving = np.concatenate([*moving, ego_rectangles(ego, seconds)])
    places = np.unique(np.floor(moving[:, 0] / BLOCK).astype(int), axis=0)
    for x, y in places.tolist():
        for heading in (0, 1):
            for car in StreetScenery(CityBlock((x, y), heading), BLOCK, WORLD.random_seed).parked(16):
                at, size = np.array([car.x, car.y]), EXTENTS[car.kind]
                halves = np.array([[size[0] / 2, 0.0], [0.0, size[1] / 2]])
                if heading:
                    at, halves = np.array([-at[1], at[0]]), halves[:, ::-1]
                own = np.array([at + BLOCK * np.array([x, y]), *halves])
                near = np.linalg.norm(moving[:, 0] - own[0], axis=1) < 9.0
                assert gaps(moving[near], np.tile(own, (near.sum(), 1, 1))).min(initial=1.0) > 0.0


def test_they_come_and_go_out_of_sight(users, ego):
    for user in users:
        assert user.end - user.begin < 2 * MAX_LIFE_S + 1.0
        times = np.array([user.begin, user.end])
        from_ego, own = ego.poses(times)[:, :2, 3], user.path.poses(times)[:, :2, 3]
        away = np.linalg.norm(own - from_ego, axis=1) > FAR[user.group]
        assert (away | hidden(from_ego, own, BLOCK)).all(), user.name


def test_people_walk_on_their_walkways_and_vehicles_are_what_their_kind_says(users):
    for user in {user.kind: user for user in users}.values():
        body, category, _ = user.body()
        assert (body.size[:2] < np.array(EXTENTS[user.kind]) + 1e-6).all(), user.name
        assert category.startswith({"vehicle": "vehicle.", "cyclist": "vehicle.bicycle"}.get(user.group, "human."))
    for user in users:
        if user.kind == "pedestrian":
            along = user.path.distances(np.array([user.begin, user.end]))
            assert np.abs(along - BLOCK / 2).max() < BLOCK / 2 - 12.0, "between the crossings"
