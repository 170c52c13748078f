"""Effects of the settings of a synthetic world; equal settings give equal bytes."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from drivesplat.demo.recorder import Recorder
from drivesplat.demo.rig import SENSORS
from drivesplat.demo.world import make_world
from drivesplat.settings.world import WorldJob, WorldSettings

FRONT = next(sensor for sensor in SENSORS if sensor.channel == "CAM_FRONT")
SMALL = {"width": 96, "samples_per_pixel": 1}


def job(**settings) -> WorldJob:
    return WorldJob(scene="demo", version="v1.0-mini", world=WorldSettings(**settings))


STILL = job(width=64, samples_per_pixel=1, key_frames=2, vehicles=0, pedestrians=0, ego="stands", sweeps=("LIDAR_TOP",))


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def table(root: Path, name: str) -> list[dict]:
    return json.loads((root / "v1.0-mini" / f"{name}.json").read_text())


@pytest.fixture(scope="module")
def still_street(tmp_path_factory) -> Path:
    """A static world with LiDAR sweeps between key frames."""
    root = tmp_path_factory.mktemp("still")
    make_world(root, STILL, {"stages": {}}, workers=2)
    return root


def test_the_same_settings_give_the_same_bytes_with_one_worker_and_with_two(tmp_path):
    tiny = job(width=64, samples_per_pixel=1, key_frames=2, vehicles=1, parked=2, night=True)
    for workers in (1, 2):
        make_world(tmp_path / str(workers), tiny, {"stages": {"demo_world": {"code": "x"}}}, workers)
    one, two = files(tmp_path / "1"), files(tmp_path / "2")
    assert len(one) > 30 and one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []


def test_another_random_seed_gives_another_street():
    a, again, b = (Recorder(WorldSettings(random_seed=s, **SMALL)).image(FRONT, 0) for s in (1, 1, 2))
    np.testing.assert_array_equal(a, again)
    assert (a != b).any(axis=2).mean() > 0.2


def test_making_a_world_anew_replaces_the_old_one(tmp_path, still_street):
    root = tmp_path / "again"
    shutil.copytree(still_street, root)
    bare = STILL.world.model_copy(update={"sweeps": (), "parked": 0})
    make_world(root, STILL.model_copy(update={"world": bare}), {"stages": {"demo_world": {"code": "new"}}}, 2)
    images = {str(path.relative_to(root)) for path in root.glob("samples/*/*")}
    assert len(images) == 2 * 7 and not (root / "sweeps").exists()
    assert images == {data["filename"] for data in table(root, "sample_data")}
    for path in root.glob("samples/CAM_FRONT/*"):
        assert path.read_bytes() != (still_street / path.relative_to(root)).read_bytes()
    assert table(root, "log") != table(still_street, "log"), "what is made from the tables is to be remade"


def test_without_moving_objects_no_vehicle_leads(still_street):
    attributes = {row["token"]: row["name"] for row in table(still_street, "attribute")}
    used = {attributes[token] for row in table(still_street, "sample_annotation") for token in row["attribute_tokens"]}
    assert used == {"vehicle.parked"}
    truth = json.loads((still_street / "truth" / "truth.json").read_text())
    assert truth["leading"] is None
    assert [frame["without_leading"] for frame in truth["frames"]] == [None, None]
    assert {path.name for path in (still_street / "truth").iterdir()} == {"truth.json", "lateral", "depth", "instances"}


def test_a_standing_ego_vehicle_has_one_pose(still_street):
    poses = {json.dumps([row["translation"], row["rotation"]]) for row in table(still_street, "ego_pose")}
    assert len(poses) == 1


def test_images_of_a_static_street_are_equal_at_all_times(still_street):
    first, last = (np.asarray(Image.open(path)) for path in sorted(still_street.glob("samples/CAM_BACK/*")))
    np.testing.assert_array_equal(first, last)


def test_the_sensors_asked_for_record_between_key_frames(still_street):
    assert [path.name for path in (still_street / "sweeps").iterdir()] == ["LIDAR_TOP"]
    assert len(list((still_street / "sweeps" / "LIDAR_TOP").iterdir())) == 9
    lidar = [row for row in table(still_street, "sample_data") if "LIDAR_TOP" in row["filename"]]
    times = np.array([row["timestamp"] for row in lidar])
    assert (np.diff(times) == 50_000).all() and [row["is_key_frame"] for row in lidar] == [True, *[False] * 9, True]


@pytest.fixture(scope="module")
def night() -> Recorder:
    return Recorder(WorldSettings(night=True, **SMALL))


def test_night_is_darker_than_day(night):
    dark, light = night.image(FRONT, 0), Recorder(WorldSettings(**SMALL)).image(FRONT, 0)
    assert dark.mean() < 0.6 * light.mean()
    assert dark[:20].mean() < 0.4 * light[:20].mean(), "the sky most of all"
    assert dark.max() > 150, "lamps shine"


def test_images_by_night_have_sensor_noise_and_the_truth_has_none(night):
    image, truth = night.image(FRONT, 500_000).astype(float), night.truth(FRONT, 500_000, 2.0)
    away = ~binary_dilation(truth["objects"] == [t.name for t in night.objects].index("vehicle 0"), iterations=2)
    lit = away & (image.min(axis=2) > 20) & (image.max(axis=2) < 235)
    difference = (image - truth["without_leading"])[lit]
    assert lit.sum() > 1000
    assert difference.std() == pytest.approx(0.012 * 255, rel=0.15) and abs(difference.mean()) < 0.3
    again = night.truth(FRONT, 500_000, 2.0)
    np.testing.assert_array_equal(truth["lateral"], again["lateral"])


def test_by_day_images_have_no_noise_that_their_truth_lacks():
    day = Recorder(WorldSettings(vehicles=1, pedestrians=0, **SMALL))
    same = (day.image(FRONT, 0) == day.truth(FRONT, 0, 2.0)["without_leading"]).all(axis=2)
    assert same.mean() > 0.8


def test_noise_differs_from_image_to_image():
    night = Recorder(WorldSettings(night=True, ego="stands", vehicles=0, pedestrians=0, **SMALL))
    assert (night.image(FRONT, 0) != night.image(FRONT, 500_000)).any(axis=2).mean() > 0.5
    np.testing.assert_array_equal(night.image(FRONT, 0), night.image(FRONT, 0))


@pytest.fixture(scope="module", params=[0, 1, 7])
def noisy_and_exact(request):
    """Noisy and exact poses at 12 Hz over a drive of 20 key frames."""
    times = np.arange(0.0, 9.5, 1 / 12)
    noisy, exact = (Recorder(WorldSettings(pose_noise=n, random_seed=request.param, **SMALL)) for n in (True, False))
    return [np.array([recorder.ego_to_global(float(t)) for t in times]) for recorder in (noisy, exact)]


def test_noisy_poses_are_flat_and_tilted_by_half_a_degree(noisy_and_exact):
    noisy, exact = noisy_and_exact
    assert (noisy[:, 2, 3] == 0.0).all() and np.ptp(exact[:, 2, 3]) > 0.005
    turn = Rotation.from_matrix(np.swapaxes(exact[:, :3, :3], 1, 2) @ noisy[:, :3, :3])
    roll, pitch, yaw = np.degrees(turn.as_euler("xyz")).T
    for angle in (roll, pitch):
        assert 0.2 < np.median(np.abs(angle)) < 1.5 and np.abs(angle).max() < 1.5
    assert np.abs(yaw).max() < 0.05


def test_position_errors_are_centimetres_and_smooth(noisy_and_exact):
    noisy, exact = noisy_and_exact
    offset = (noisy - exact)[:, :2, 3]
    distance = np.linalg.norm(offset, axis=1)
    assert 0.01 < np.median(distance) < 0.08 and distance.max() < 0.1
    assert np.linalg.norm(np.diff(offset, axis=0), axis=1).max() < 0.02
    ups = noisy[:, :3, 2]
    steps = np.degrees(np.arccos(np.clip((ups[1:] * ups[:-1]).sum(axis=1), -1, 1)))
    assert steps.max() < 0.4, "no jumps between images"


def test_pose_noise_leaves_images_and_sweeps_alone():
    noisy, exact = (Recorder(WorldSettings(pose_noise=n, **SMALL)) for n in (True, False))
    np.testing.assert_array_equal(noisy.image(FRONT, 500_000), exact.image(FRONT, 500_000))
    np.testing.assert_array_equal(noisy.sweep(SENSORS[0], 500_000)[0], exact.sweep(SENSORS[0], 500_000)[0])


@pytest.mark.parametrize(("vehicles", "pedestrians", "parked"), [(0, 0, 0), (1, 2, 3), (6, 6, 16)])
@pytest.mark.parametrize("ego", ["drives", "stands"])
def test_the_street_has_the_configured_number_of_objects(vehicles, pedestrians, parked, ego):
    settings = {"vehicles": vehicles, "pedestrians": pedestrians, "parked": parked, "ego": ego}
    recorder = Recorder(WorldSettings(**settings))
    kinds = [(item.category or "").split(".")[0] for item in recorder.objects if item.moves]
    assert (kinds.count("vehicle"), kinds.count("human")) == (vehicles, pedestrians)
    assert sum(item.attribute == "vehicle.parked" for item in recorder.objects) == parked
    assert recorder.street.leading == ("vehicle 0" if vehicles else None)
    names = [item.name for item in recorder.objects]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("random_seed", "vehicles", "pedestrians", "parked"), [(0, 2, 1, 9), (1, 6, 6, 16), (2, 2, 6, 9)]
)
@pytest.mark.parametrize("ego", ["drives", "stands"])
def test_objects_do_not_intersect(ego, random_seed, vehicles, pedestrians, parked):
    counts = {"vehicles": vehicles, "pedestrians": pedestrians, "parked": parked}
    recorder = Recorder(WorldSettings(random_seed=random_seed, ego=ego, **counts))
    boxed = [item for item in recorder.objects if item.category]
    for seconds in np.arange(0.0, 9.6, 0.25):
        ego_pose = recorder.ego_to_street(float(seconds))
        places = [*(item.path.pose_at(float(seconds))[:2, 3] for item in boxed), ego_pose[:2, 3] + [1.4, 0.0]]
        halves = [*(item.mesh.size[:2] / 2 for item in boxed), np.array([2.3, 0.95])]
        for i in range(len(places)):
            for j in range(i):
                gap = np.abs(places[i] - places[j]) - halves[i] - halves[j]
                assert gap.max() > 0.0, (seconds, i, j)


def test_the_leading_car_leads():
    for ego in ("drives", "stands"):
        recorder = Recorder(WorldSettings(ego=ego))
        leading = next(item for item in recorder.objects if item.name == recorder.street.leading)
        for seconds in (0.0, 4.0, 9.5):
            ahead = np.linalg.inv(recorder.ego_to_street(seconds)) @ leading.path.pose_at(seconds)
            assert ahead[0, 3] > 5.0 and abs(ahead[1, 3]) < 1.0


@pytest.mark.parametrize("width", [64, 400, 1600])
def test_width_sets_the_images_size_and_scales_the_intrinsics(width):
    camera = Recorder(WorldSettings(width=width)).camera(FRONT, 0.0)
    assert (camera.width, camera.height) == (width, width * 9 // 16)
    scale = width / 1600
    assert camera.intrinsics[0, 0] == camera.intrinsics[1, 1] == pytest.approx(1266.4 * scale)
    np.testing.assert_allclose(camera.intrinsics[:2, 2] + 0.5, np.array([816.8, 492.0]) * scale)


def test_pedestrians_avoid_lamps_bins_and_trees():
    for seed in range(6):
        recorder = Recorder(WorldSettings(random_seed=seed, pedestrians=6, vehicles=0))
        scenery = recorder.objects[0].mesh.vertices
        feet = scenery[(scenery[:, 2] > -0.01) & (scenery[:, 2] < 0.01)][:, :2]
        walkers = [item for item in recorder.objects if item.walks]
        assert len(walkers) == 6
        for walker in walkers:
            for seconds in np.arange(0.0, 20.0, 0.2):
                beside = np.abs(feet - walker.path.pose_at(float(seconds))[:2, 3]) < walker.mesh.size[:2] / 2
                assert not beside.all(axis=1).any(), (seed, walker.name, seconds)


def test_unoccluded_pedestrians_are_wholly_visible():
    recorder = Recorder(WorldSettings(pedestrians=6, vehicles=0, parked=0, key_frames=8, **SMALL))
    walkers = [number for number, item in enumerate(recorder.objects) if item.walks]
    assert np.median([recorder.visible_fractions(index)[walkers] for index in (1, 4, 7)]) > 0.95
