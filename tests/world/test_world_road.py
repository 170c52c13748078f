"""The road: lengths, headings and heights of bends and slopes, and objects that stand on its ground."""

import numpy as np
import pytest
import trimesh
from helpers.demo_worlds import named, recorder_of, world_of

from drivesplat.world.street.objects import EGO_PARTS
from drivesplat.world.street.road import STRAIGHT
from drivesplat.world.street.street import BEND_RADIUS, RISE, road_of

S = np.linspace(-40.0, 220.0, 26_001)
STEP = S[1] - S[0]


@pytest.mark.parametrize(("bend", "grade"), [(35.0, 0.06), (-60.0, -0.12), (0.0, 0.06), (35.0, 0.0)])
def test_the_centre_line_has_its_length_heading_radius_and_slope(bend, grade):
    road = road_of(world_of(bend_deg=bend, grade=grade))
    step, middle = np.diff(road.center(S)[:, :2], axis=0), (S[1:] + S[:-1]) / 2
    np.testing.assert_allclose(np.linalg.norm(step, axis=1), STEP, rtol=1e-6, err_msg="metres on the map")
    np.testing.assert_allclose(np.arctan2(step[:, 1], step[:, 0]), road.heading(middle), atol=1e-4)
    heading, turning = np.degrees(road.heading(S)), np.abs(np.diff(road.heading(S))) / STEP
    assert heading[0] == 0.0 and heading[-1] == pytest.approx(bend, abs=1e-9)
    assert not bend or turning.max() == pytest.approx(1 / BEND_RADIUS, rel=1e-6)
    np.testing.assert_allclose(np.diff(road.elevation(S)) / STEP, road.slope(middle), atol=1e-5)
    assert np.abs(road.slope(S)).max() == pytest.approx(abs(grade))
    assert road.elevation(S)[0] == 0.0 and road.slope(S)[[0, -1]].tolist() == [0.0, 0.0]
    assert road.elevation(S)[-1] == pytest.approx(grade * (RISE[1] - RISE[0]), abs=1e-9)
    assert np.abs(np.diff(road.slope(S))).max() < 0.12 / 30.0 * STEP * 1.01, "no kink"


def test_a_straight_level_road_is_the_street_itself():
    assert road_of(world_of()) is STRAIGHT and STRAIGHT.is_straight
    places = np.random.default_rng(0).uniform(-50, 150, (20, 3))
    np.testing.assert_array_equal(STRAIGHT.points(places), places)
    poses = STRAIGHT.poses(places[:, 0], places[:, 1], np.zeros(20))
    np.testing.assert_array_equal(poses[:, :3, :3], np.tile(np.eye(3), (20, 1, 1)))
    np.testing.assert_array_equal(poses[:, :2, 3], places[:, :2])
    mesh = named(recorder_of(), "cone 0").body.pieces[0]
    assert STRAIGHT.follow(mesh) is mesh


@pytest.mark.parametrize(("bend", "grade"), [pytest.param(0.0, 0.0, marks=pytest.mark.slow), (-60.0, -0.12)])
@pytest.mark.slow
def test_objects_stand_on_the_ground(bend, grade):
    """A ray straight down from half a metre above an object's origin meets the ground at the origin."""
    recorder = recorder_of(
        bend_deg=bend, grade=grade, vehicles=4, pedestrians=12, bystanders=3, cyclists=2, dogs=2, parked=16
    )
    scenery = named(recorder, "scenery").body.pieces[0]
    ground = trimesh.Trimesh(scenery.vertices, scenery.faces, process=False)
    items = [item for item in recorder.objects if item.category]
    assert not {item.name for item in items} & set(EGO_PARTS)
    for seconds in (0.0, 4.0, 9.0):
        places = np.array([item.poses(np.array([seconds]))[0, :3, 3] for item in items])
        places = np.concatenate([places, recorder.ego_to_street(np.array([seconds]))[:, :3, 3]])
        above, down = places + np.array([0.0, 0.0, 0.5]), np.tile([0.0, 0.0, -1.0], (len(places), 1))
        points, rays, _ = ground.ray.intersects_location(above, down, multiple_hits=False)
        assert set(rays.tolist()) == set(range(len(places)))
        height = np.abs(points[np.argsort(rays), 2] - places[:, 2])
        assert height.max() < 0.03, items[int(height[:-1].argmax())].name
