"""The streets near a route: ground everywhere, no house in the road, and images without holes."""

from collections.abc import Iterator
from itertools import combinations

import numpy as np
import pytest
from helpers.demo_worlds import FRONT, LIDAR, world_of

from drivesplat.world.layout import ROAD, SIDEWALK
from drivesplat.world.optics.imaging import geometry
from drivesplat.world.optics.raycast import NO_HIT, StreetRays
from drivesplat.world.recorder import Recorder
from drivesplat.world.route import scenery, stretch
from drivesplat.world.route.grid import CityBlock
from drivesplat.world.route.scenery import StreetScenery
from drivesplat.world.route.stretch import RouteDrive, Stretch
from drivesplat.world.shapes.mesh import SurfaceClass

WORLD = world_of(route={}, vehicles=1, pedestrians=1, parked=2, key_frames=61, width=128)
BLOCK = WORLD.route.block_m
TURN = 28.0
"""A second in the first turn, within the third stretch."""


@pytest.fixture(scope="module")
def drive() -> Iterator[RouteDrive]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenery, "MAKES", 3)
        for name, value in (("HOUSES", 200.0), ("LINE_HOUSES", 300.0), ("LINE_TREES", 60.0), ("PARKED", 60.0)):
            patch.setattr(stretch, name, value)
        yield RouteDrive(WORLD)


@pytest.fixture(scope="module")
def third(drive) -> Stretch:
    return drive.stretch(2)


@pytest.fixture(scope="module")
def recorder(third) -> Recorder:
    return Recorder(WORLD, street=third.street)


def straight_down(recorder: Recorder, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of the scenery below places (n, 2) in the stretch's frame, from 0.5 m above them, and its classes."""
    origins = np.column_stack([places, np.full(len(places), 0.5)])
    down, caster = np.tile([0.0, 0.0, -1.0], (len(places), 1)), recorder._caster(None)
    moments = np.arange(len(places), dtype=np.int32)
    hits = caster.at(np.full(len(places), TURN)).cast(StreetRays(np.full(len(places), TURN), origins, down, moments))
    assert (hits.object != NO_HIT).all()
    return 0.5 - hits.distance, caster.surface_class[hits.face]


def test_the_vehicle_drives_on_road_at_height_zero(recorder):
    poses = recorder.ego_to_street(np.arange(21.0, 30.0, 0.1))
    assert np.abs(poses[:, 2, 3]).max() < 0.03, "heave of the suspension alone"
    for aside in (-0.9, 0.0, 0.9):
        height, kind = straight_down(recorder, poses[:, :2, 3] + aside * poses[:, :2, 1])
        np.testing.assert_allclose(height, 0.0, atol=1e-3)
        assert (kind == SurfaceClass.ROAD).all()


def test_there_is_ground_everywhere(recorder):
    places = np.random.default_rng(0).uniform(-900.0, 900.0, (8000, 2))
    from_street = np.abs((places + BLOCK / 2) % BLOCK - BLOCK / 2).min(axis=1)
    near = np.abs(places).max(axis=1) < 150.0
    height, kind = straight_down(recorder, places)
    free = height < 0.4  # not within a house
    assert free.mean() > 0.5 and height[free].min() > -0.06
    assert (kind[near & (from_street < ROAD - 0.1) & (height < 0.05)] == SurfaceClass.ROAD).mean() > 0.99
    walked = near & (from_street > ROAD + 0.3) & (from_street < SIDEWALK - 0.1) & (height < 0.05)
    assert np.isin(kind[walked], [SurfaceClass.SIDEWALK, SurfaceClass.ROAD]).all()
    assert (kind[walked] == SurfaceClass.SIDEWALK).mean() > 0.8, "and the road where streets cross"


def test_the_middle_of_crossings_has_no_paint(drive, recorder, third):
    crossing = np.array(drive.ego.crossing(drive.ego.street_at(float(drive.ego.distances(np.array([TURN]))[0]))))
    assert np.linalg.norm(crossing * BLOCK - third.origin - recorder.ego_pose(TURN)[:2, 3]) < SIDEWALK
    picture = recorder.geometry(FRONT, round(26e6))
    assert picture.markings.any(), "lanes of the street beyond the crossing"
    y, x = np.nonzero(picture.markings)
    camera = recorder.camera(FRONT, 26.0)
    rays = camera.rays(x.astype(float), y.astype(float), y)
    far = picture.depth[y, x] / (rays.directions @ camera.pose[:3, 2])
    points = camera.pose[:3, 3] + far[:, None] * rays.directions
    from_crossing = np.abs(points[:, :2] + third.origin - crossing * BLOCK).max(axis=1)
    assert from_crossing.min() > SIDEWALK - 0.5


@pytest.mark.parametrize("second", [22.0, 27.5, 29.0])
def test_images_have_no_holes_below_the_horizon(recorder, second):
    camera = recorder.camera(FRONT, second)
    picture = geometry(recorder.snapshot(camera.seconds), camera)
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(x.ravel().astype(float), y.ravel().astype(float), y.ravel())
    down = (rays.directions[:, 2] < -2e-3).reshape(picture.depth.shape)
    assert np.isfinite(picture.depth[down]).all() and down.mean() > 0.3
    assert (picture.classes == SurfaceClass.SKY).any() and (picture.classes == SurfaceClass.BUILDING).mean() > 0.1


def test_the_lidar_returns_from_all_around(recorder):
    found = recorder.scan(LIDAR, round(TURN * 1e6))
    assert found.returned.mean() > 0.8
    assert found.returned.any(axis=0).all(), "of each firing"


@pytest.mark.parametrize("heading", [0, 1])
def test_houses_stand_beside_the_sidewalks_and_not_in_each_other(heading):
    for seed in range(4):
        houses = []
        for block, shift in (
            (CityBlock((seed, 3), heading), 0.0),
            (CityBlock((seed + 1 - heading, 3 + heading), heading), BLOCK),
        ):
            own = StreetScenery(block, BLOCK, seed).houses()
            houses += [np.array([house.low, house.high]) + np.array([shift, 0.0]) for house in own]
        other = StreetScenery(CityBlock((seed + 1 - heading, 3 + heading), 1 - heading), BLOCK, seed).houses()
        for house in other:  # of the street that crosses between both
            corners = np.array([house.low, house.high])
            turned = np.stack(
                [-corners[:, 1], corners[:, 0]] if not heading else [corners[:, 1], -corners[:, 0]], axis=1
            )
            houses.append(np.sort(turned, axis=0) + np.array([BLOCK, 0.0]))
        for low, high in houses:
            assert min(np.abs(low[1]), np.abs(high[1])) > SIDEWALK + 1.0
            assert high[0] < BLOCK - SIDEWALK - 1.0 or low[0] > BLOCK + SIDEWALK + 1.0
        for (low, high), (other_low, other_high) in combinations(houses, 2):
            assert ((low >= other_high - 1e-6) | (other_low >= high - 1e-6)).any()


def test_a_stretch_has_the_streets_of_the_next(drive, third):
    """Where both show houses with all details, in the frame of the grid."""
    following = drive.stretch(3)
    found = []
    for one in (third, following):
        (static,) = [item for item in one.street.objects if item.name == "scenery"]
        vertices = static.body.pieces[0].vertices[:, :2] + one.origin
        near = np.abs(vertices - drive.ego.poses(np.array([30.0]))[0, :2, 3]).max(axis=1) < 40.0
        found.append({tuple(row) for row in np.round(vertices[near], 2).tolist()})
    assert found[0] and len(found[0] ^ found[1]) < 0.02 * len(found[0])
