"""Objects of the street: as many as configured, each at a place of its own at all times."""

import numpy as np
import pytest
from helpers.demo_worlds import SENSOR_SETTINGS, SMALL, named, pose_at, recorder_of, world_of
from helpers.ground_rectangles import EGO_CENTER, EGO_SIZE, meetings, rectangles
from helpers.world_digests import digest

from drivesplat.settings.world import WorldSettings
from drivesplat.world.recorder import Recorder

pytestmark = pytest.mark.slow

EVERYTHING = {"pedestrians": 20, "bystanders": 6, "cyclists": 3, "dogs": 3}
WORLDS = {
    "default": {},
    "others": {"random_seed": 1, "vehicles": 6, "parked": 16, **EVERYTHING},
    "standing": {"random_seed": 2, "ego": "stands", "vehicles": 6, "parked": 16, **EVERYTHING},
    "queue": {"random_seed": 3, "traffic": "queue", **EVERYTHING, "cyclists": 0},
    "bend": {"random_seed": 4, "bend_deg": 35.0, "grade": 0.06, "vehicles": 4, "parked": 16, **EVERYTHING},
}


@pytest.fixture(scope="module", params=WORLDS)
def recorder(request) -> Recorder:
    return recorder_of(**WORLDS[request.param])


COUNTED = ("vehicles", "pedestrians", "bystanders", "cyclists", "dogs", "parked")


@pytest.mark.parametrize("counts", [(0, 0, 0, 0, 0, 0), (1, 2, 3, 1, 2, 3), (6, 24, 12, 4, 4, 16)])
@pytest.mark.parametrize("ego", ["drives", "stands"])
def test_the_street_has_the_configured_number_of_objects(counts, ego):
    recorder = recorder_of(ego=ego, **dict(zip(COUNTED, counts, strict=True)))
    names = [item.name for item in recorder.objects]
    kinds = [name.split()[0] for name in names]
    assert tuple(kinds.count(kind.removesuffix("s")) for kind in COUNTED) == counts and len(set(names)) == len(names)
    assert sum(item.attribute == "vehicle.parked" for item in recorder.objects) == counts[-1]
    assert recorder.street.leading == ("vehicle 0" if counts[0] else None)


def test_a_queue_takes_the_place_of_free_traffic():
    recorder = recorder_of(traffic="queue", vehicles=0)
    kinds = [item.name.split()[0] for item in recorder.objects]
    assert (kinds.count("vehicle"), kinds.count("oncoming")) == (4, 8) and recorder.street.leading == "vehicle 0"
    nose, ahead = recorder.ego_pose(4.0)[0, 3] + EGO_CENTER + EGO_SIZE[0] / 2, named(recorder, "vehicle 0")
    gap = pose_at(ahead, 4.0)[0, 3] - ahead.size[0] / 2 - nose
    assert 3.0 < gap < 7.0, "at close range"


def test_settings_of_sensors_and_light_leave_the_street_as_it_is():
    """`recorder_of` shares a street among worlds that differ in them."""
    other = {"night": True, "wet": True, "width": 64, "samples_per_pixel": 4, "cameras": ("CAM_BACK",),
             "sweeps": ("LIDAR_TOP",), "image_hz": 20, "lidar_hz": 10, "readout_s": 0.02, "pose_noise": True,
             "exposures": {"CAM_BACK": (1.1, 1.0, 0.9)}, "class_maps": True, "truth": {"lidar": True}}  # fmt: skip
    assert set(other) == SENSOR_SETTINGS
    worlds = world_of(key_frames=4), world_of(key_frames=4, lidar={"beams": 64, "spins": True}, **other)
    assert len({digest(Recorder(world)) for world in worlds}) == 1


def test_objects_do_not_intersect(recorder):
    assert meetings(recorder) == []


def test_people_and_animals_avoid_lamps_bins_and_trees(recorder):
    """None of them touches what stands on the sidewalk: scenery from ankle to shoulder height."""
    scenery, road = named(recorder, "scenery").body.pieces[0], recorder.street.road
    height = scenery.triangles[..., 2] - road.elevation(scenery.triangles[..., 0])
    standing = scenery.triangles[((height > 0.15) & (height < 1.4)).any(axis=1) & (np.abs(height) < 4.0).all(axis=1)]
    points = np.concatenate([standing.reshape(-1, 3), standing.mean(axis=1)])[:, :2]
    assert len(points) > 500
    seconds = np.arange(0.0, recorder.world.seconds, 0.2)
    walkers = [item for item in recorder.objects if (item.category or "").startswith(("human", "animal"))]
    for walker in walkers:
        found = rectangles(walker, seconds)
        near = points[((points > found[:, 0].min(axis=0) - 2.0) & (points < found[:, 0].max(axis=0) + 2.0)).all(axis=1)]
        offset = near - found[:, :1]
        inside = [
            np.abs((offset * half[:, None]).sum(axis=2)) < (half**2).sum(axis=1)[:, None]
            for half in (found[:, 1], found[:, 2])
        ]
        assert not (inside[0] & inside[1]).any(), walker.name


@pytest.mark.parametrize(("walkways", "low", "high"), [(["sidewalk"], 6.65, 10.0), (["road"], 2.7, 6.4)])
def test_pedestrians_walk_where_they_are_asked_to(walkways, low, high):
    recorder = recorder_of(pedestrians=9, walkways=walkways)
    walkers = [item for item in recorder.objects if item.name.startswith("pedestrian")]
    assert len(walkers) == 9
    for item in walkers:
        aside = np.abs(item.poses(np.linspace(0.0, 9.5, 20))[:, 1, 3])
        assert (aside > low).all() and (aside < high).all(), item.name


@pytest.mark.parametrize(
    ("setting", "value"),
    [("width", 10), ("pedestrians", 25), ("cyclists", 5), ("bend_deg", 61.0), ("grade", 0.2), ("readout_s", 0.2),
     ("key_frame_hz", 5), ("image_hz", 15), ("lidar_hz", 15), ("lidar", {"beams": 16}), ("traffic", "jam"),
     ("lidar", {"divergence_mrad": 11.0}), ("truth", {"lateral_m": [7.0]}), ("truth", {"cameras": ["LIDAR_TOP"]}),
     ("cameras", ["CAM_TOP"]), ("exposures", {"CAM_FRONT": [0.0, 1.0, 1.0]})],
)  # fmt: skip
def test_settings_out_of_range_are_refused(setting, value):
    with pytest.raises(ValueError, match=setting):
        WorldSettings(**{**SMALL, setting: value})


def test_image_rates_are_multiples_of_the_key_frames():
    with pytest.raises(ValueError, match=r"image_hz is 12, no multiple of key_frame_hz \(10\)"):
        WorldSettings(key_frame_hz=10)
