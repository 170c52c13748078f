"""LiDAR rays, each at its own time, against ray casting on meshes that are posed at that time."""

import numpy as np
import pytest
from helpers.demo_worlds import FRONT, LIDAR, meshes_at, named, names_of, pose_at, recorder_of

from drivesplat.settings.world import WorldLidarSettings
from drivesplat.world.optics.lidar import MAX_RANGE, StreetScan, scan, scan_pattern
from drivesplat.world.optics.raycast import RayCaster
from drivesplat.world.recorder import Recorder, Viewpoint
from drivesplat.world.shapes.mesh import Material, box
from drivesplat.world.street.objects import EGO_BODY, EGO_PARTS, StreetObject, fixed

TIME_US = 2_000_000
EVERYBODY = {"vehicles": 3, "pedestrians": 12, "bystanders": 3, "cyclists": 2, "dogs": 2}
WORLDS = {
    "straight": {"lidar": {"spins": True, "ego_returns": True}, **EVERYBODY},
    "bend": {"lidar": {"spins": True, "beams": 64}, "lidar_hz": 10, "bend_deg": 35.0, "grade": 0.06, **EVERYBODY},
    "at once": {"lidar": {"spins": False}, **EVERYBODY},
}


@pytest.fixture(
    scope="module", params=["straight", *(pytest.param(name, marks=pytest.mark.slow) for name in ("bend", "at once"))]
)
def recorder(request) -> Recorder:
    return recorder_of(**WORLDS[request.param])


@pytest.fixture(scope="module")
def found(recorder) -> StreetScan:
    return recorder.scan(LIDAR, TIME_US)


def rays_of(recorder: Recorder, step: int, left: float = 0.0) -> tuple[float, np.ndarray, np.ndarray]:
    """Second, origin (3,) and directions (beams, 3) in the street frame of one step of the azimuth."""
    pattern = recorder.pattern
    seconds = TIME_US * 1e-6 + float(pattern.offsets[step])
    pose = recorder.ego_pose(seconds) @ LIDAR.sensor_to_ego
    origin = pose[:3, 3] + left * recorder.ego_pose(seconds)[:3, 1]
    azimuth, elevation = float(pattern.azimuths[step]), pattern.elevations
    local = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=-1
    )
    return seconds, origin, local @ pose[:3, :3].T


def by_hand(triangles: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    """The distance to the first of `triangles` (f, 3, 3): Moeller and Trumbore (1997), in float64."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    p = np.cross(direction, c - a)
    determinant = ((b - a) * p).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((origin - a) * p).sum(axis=1) / determinant
        q = np.cross(origin - a, b - a)
        v, distance = (q @ direction) / determinant, ((c - a) * q).sum(axis=1) / determinant
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return float(distance[hit].min(initial=np.inf))


def not_ego(item: StreetObject, left: float) -> bool:
    """Whether an object is there when the sensor moves `left` metres aside: the ego vehicle is not."""
    return not left or item.name not in EGO_PARTS


@pytest.mark.parametrize("left", [0.0, pytest.param(2.0, marks=pytest.mark.slow)])
def test_some_ranges_are_those_of_every_triangle_tried_in_double_precision(recorder, left):
    found = recorder.scan(LIDAR, TIME_US, Viewpoint(left=left))
    numbers = [n for n, item in enumerate(recorder.objects) if item.moves and (found.object == n).any()]
    rays = [tuple(np.argwhere(found.object == n)[len(np.argwhere(found.object == n)) // 2]) for n in numbers]
    rays += [(beam, step) for beam in (2, 9, 17, 25) for step in range(40, found.range.shape[1], 411)]
    by_step: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    good = 0
    for beam, step in rays:
        if step not in by_step:
            seconds, origin, directions = rays_of(recorder, int(step), left)
            triangles = np.concatenate([meshes_at(item, seconds) for item in recorder.objects if not_ego(item, left)])
            by_step[step] = triangles, origin, directions
        triangles, origin, directions = by_step[step]
        good += abs(by_hand(triangles, origin, directions[beam]) - found.range[beam, step]) < 1e-3 or (
            not np.isfinite(found.range[beam, step])
        )
    assert good >= len(rays) - 1, "but for a ray at an edge"


def test_the_ego_vehicle_returns_beams_only_where_asked_to_and_no_camera_sees_it():
    without, own = (recorder_of(lidar={"ego_returns": asked}) for asked in (False, True))
    assert EGO_BODY not in names_of(without)
    number = names_of(own).index(EGO_BODY)
    scans = [recorder.scan(LIDAR, TIME_US) for recorder in (without, own)]
    hit = scans[1].object == number
    assert hit.sum() > 100 and (scans[1].range[hit] < scans[0].range[hit]).all()
    np.testing.assert_array_equal(scans[0].range[~hit], scans[1].range[~hit])
    to_ego = LIDAR.sensor_to_ego
    body = own.returns(scans[1], LIDAR, TIME_US)[hit[scans[1].returned], :3].astype(float)
    in_ego = body @ to_ego[:3, :3].T + to_ego[:3, 3]
    assert (np.abs(in_ego[:, 1]) < 1.1).all() and (np.abs(in_ego[:, 0] - 1.4) < 2.7).all()
    np.testing.assert_array_equal(*(recorder.image(FRONT, TIME_US) for recorder in (without, own)))


def rear_of_the_car_ahead(recorder: Recorder) -> tuple[float, float]:
    """How far the rear's returns lie behind the box at the timestamp (metres), and the speed of the car (m/s)."""
    found, seconds = recorder.scan(LIDAR, TIME_US), TIME_US * 1e-6
    item = named(recorder, "vehicle 0")
    own = found.object[found.returned] == names_of(recorder).index("vehicle 0")
    points = recorder.returns(found, LIDAR, TIME_US)[own, :3].astype(float)
    to_box = np.linalg.inv(pose_at(item, seconds)) @ recorder.ego_pose(seconds) @ LIDAR.sensor_to_ego
    rear = (points @ to_box[:3, :3].T + to_box[:3, 3])[:, 0]
    step = pose_at(item, seconds + 0.01) - pose_at(item, seconds - 0.01)
    return -item.size[0] / 2 - float(np.quantile(rear, 0.3)), float(np.linalg.norm(step[:3, 3])) / 0.02


def test_a_moving_car_ahead_is_displaced_by_its_speed_times_the_rays_time():
    """The beams point forward 35.5 ms before the timestamp. The sensor's motion is compensated, that of cars is not."""
    (still, speed), (spun, _) = (rear_of_the_car_ahead(recorder_of(lidar={"spins": s})) for s in (False, True))
    assert speed > 8.0
    assert spun - still == pytest.approx(0.0355 * speed, abs=0.02)


def test_returns_are_dropped_by_range_and_by_what_they_reflect(recorder, found):
    """A return needs about 5 % of the light at 100 m, as little as the square of the range allows nearer."""
    margin = found.intensity / (0.05 * (found.range / MAX_RANGE) ** 2)
    inside = np.isfinite(found.range) & (found.range > 0.9) & (found.range < MAX_RANGE)
    assert not found.returned[~inside].any()
    assert found.returned[inside & (margin > 1.5)].all() and not found.returned[inside & (margin < 0.5)].any()
    between = found.returned[inside & (margin > 0.7) & (margin < 1.3)]
    if len(between) > 50:
        assert 0.2 < between.mean() < 0.8
    assert (found.range[inside & ~found.returned] > 5.0).any(), "far and grazing rays are lost"


PATTERN = scan_pattern(WorldLidarSettings(beams=64), 20)


def scanned(objects: list, **lidar) -> StreetScan:
    """A scan from the origin of a dry street of `objects`, y ahead."""
    steps = len(PATTERN.azimuths)
    poses, times = np.tile(np.eye(4), (steps, 1, 1)), np.zeros(steps)
    settings = WorldLidarSettings(beams=64, **lidar)
    return scan(RayCaster(objects).at(times), PATTERN, poses, times, settings, 0.0, np.random.default_rng(0))


def test_grazing_rays_return_less_than_steep_ones():
    """On the ground 1.8 m below the sensor."""
    ground = box((-200.0, -200.0, -2.8), (200.0, 200.0, -1.8), Material.PLAIN, (0.3,) * 3)
    found = scanned([fixed("ground", ground)])
    hit = np.isfinite(found.range)
    cosine = 1.8 / found.range[hit]
    reflectivity = found.intensity[hit] / cosine
    steep, flat = cosine > 0.2, (cosine < 0.15) & (cosine > 0.05)
    assert reflectivity[flat].mean() == pytest.approx(reflectivity[steep].mean(), rel=0.1), "Lambert's cosine law"
    assert found.returned[hit][steep].all() and not found.returned[hit & (found.range > 60.0)].any()


def test_a_wide_beam_returns_another_range_only_at_edges():
    """A plate 2 m wide and high, 5 m before a dark wall, without and with a divergence of 6 mrad."""
    plate = fixed("plate", box((-1.0, 10.0, -1.0), (1.0, 10.02, 1.0), Material.PLAIN, (0.4,) * 3))
    behind = fixed("wall", box((-200.0, 15.0, -50.0), (200.0, 60.0, 50.0), Material.PLAIN, (0.05,) * 3))
    thin, wide = (scanned([plate, behind], divergence_mrad=mrad) for mrad in (0.0, 6.0))
    x, y, z = np.moveaxis(PATTERN.directions(), -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        outside = np.maximum(np.abs(x / y), np.abs(z / y)) - 0.1  # in tangents, of the plate's half angles
    edge = (y > 0) & (np.abs(outside) < 0.0033)
    changed = np.isfinite(thin.range) & np.isfinite(wide.range)
    changed[changed] = np.abs(thin.range[changed] - wide.range[changed]) > 0.3
    assert changed.sum() > 0 and not (changed & ~edge & (thin.range < 30.0)).any()
    np.testing.assert_array_equal(thin.range[~edge & (thin.range < 12.0)], wide.range[~edge & (thin.range < 12.0)])
