"""The simulation and the Gymnasium environment, on a finished workflow."""

import math
import re
import sys
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from helpers import REPOSITORY
from helpers.shared_runs import CAR

import drivesplat
import drivesplat.simulate
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import ConfigError, RequestError
from drivesplat.settings.simulate import SimulationSettings
from drivesplat.simulate.env import DriveEnv, vector_env
from drivesplat.simulate.policies import policy_of
from drivesplat.simulate.simulation import BOX_COLUMNS, Simulation
from drivesplat.simulate.validity import ViewKnowledge

pytestmark = pytest.mark.workflow
CAMERA = "CAM_FRONT"
KEPT = np.zeros(2, dtype=np.float32)


@pytest.fixture(scope="module")
def drive(finished_run) -> TrainedDrive:
    return drivesplat.open(finished_run.folder / "results/0001/street", device="cpu")


def simulated(drive: TrainedDrive, **settings) -> Simulation:
    return Simulation(drive, SimulationSettings.model_validate({"cameras": (), **settings}))


def equal(one, other) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    return np.array_equal(one, other)


# ---- the ego vehicle


def test_following_the_recording_it_is_where_the_recorded_vehicle_was(drive):
    run = simulated(drive, recorded_until=100.0)
    while not run.ended:
        np.testing.assert_allclose(run.ego_to_world, drive.ego_to_world(run.time), atol=1e-9)
        assert run.offset < 0.1 and run.follows
        run.step(KEPT)
    speeds = run.driven().speed
    there = [drive.ego_velocity(float(time))[0] for time in run.driven().seconds]
    np.testing.assert_allclose(speeds[1:-1], there[1:-1], atol=0.05)


def test_a_hand_over_from_the_recording_makes_no_jump(drive):
    run = simulated(drive, recorded_until=0.5)
    for _ in range(10):
        run.step(KEPT)
    record = run.driven()
    assert record.loop_from == 5 and not run.follows
    steps = np.linalg.norm(np.diff(record.ego_to_world[:, :2, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, record.speed[:-1] * 0.1, atol=0.05)
    heights = record.ego_to_world[:, 2, 3]
    assert np.abs(np.diff(heights)).max() < 0.05


def test_it_drives_where_it_is_steered_and_lies_on_the_ground(drive):
    run = simulated(drive, seconds=1.5)
    start = run.ego
    while not run.ended:
        run.step([0.2, 0.0])
    assert run.ego.yaw > start.yaw + 0.05 and run.progress > 0.5 * start.speed
    up = run.ego_to_world[:3, 2]
    nearest = drive.ego_to_world(0.75)
    assert up @ nearest[:3, 2] > 0.999
    assert abs(run.ego_to_world[2, 3] - nearest[2, 3]) < 0.3


def test_poses_as_actions_are_followed(drive):
    run = simulated(drive, actions="poses", horizon=8, seconds=1.5)
    while not run.ended:
        now, ahead = run.time + 0.1 * np.arange(1, 9), []
        for time in np.minimum(now, drive.duration):
            pose = drive.ego_to_world(float(time))
            x, y = run.ego.in_frame(pose[None, :2, 3])[0]
            ahead.append((x, y, math.atan2(pose[1, 0], pose[0, 0]) - run.ego.yaw))
        run.step(np.array(ahead))
    assert math.dist(run.ego_to_world[:2, 3], drive.ego_to_world(run.time)[:2, 3]) < 0.5
    assert run.offset < 0.3


# ---- what is seen


def test_images_of_a_followed_recording_are_those_of_the_drive_byte_for_byte(drive):
    run = simulated(drive, cameras=(CAMERA,), recorded_until=100.0)
    for _ in range(3):
        run.step(KEPT)
        seen = run.observation()["cameras"][CAMERA]["rgb"]
        np.testing.assert_array_equal(seen, drive.render(CAMERA, run.time).image)


def test_images_elsewhere_are_those_of_the_vehicles_pose(drive):
    run = simulated(drive, cameras=(CAMERA,), width=48, outputs=("rgb", "depth", "instance"))
    for _ in range(4):
        run.step([0.3, 0.0])
    seen = run.observation()["cameras"][CAMERA]
    camera = drive.camera(CAMERA).resized(48)
    view = drive.render(camera, run.time, ego_to_world=run.ego_to_world, outputs=["rgb", "depth", "instance"])
    np.testing.assert_array_equal(seen["rgb"], view.image)
    np.testing.assert_allclose(seen["depth"], view.arrays()["depth"], atol=1e-5)
    np.testing.assert_array_equal(seen["instance"], view.arrays()["instance"])


def test_boxes_are_in_the_frame_of_the_vehicle_the_nearest_first(drive):
    run = simulated(drive)
    ids, boxes = run.boxes()
    assert CAR in ids and len(ids) == len(boxes) and list(BOX_COLUMNS[:3]) == ["x", "y", "z"]
    distances = np.hypot(boxes[:, 0], boxes[:, 1])
    assert (np.diff(distances) >= 0.0).all()
    pose = drive.state(0.0, outside="clamp").actors[CAR].pose
    own = boxes[ids.index(CAR)]
    np.testing.assert_allclose(own[:2], run.ego.in_frame(pose[None, :2, 3])[0], atol=0.05)
    padded = run.observation()["boxes"]
    assert padded.shape == (32, 8) and not padded[len(ids) :].any()
    few = simulated(drive, max_boxes=1)
    assert few.boxes()[0] == ids[:1] and few.observation()["boxes"].shape == (1, 8)


def test_the_route_is_the_recorded_path_ahead(drive):
    run = simulated(drive, route_points=12, route_step=0.5)
    route = run.route()
    assert route.shape == (12, 3)
    steps = np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.5, atol=0.05)
    places = drive.ego_path(np.linspace(0.0, drive.duration, 200))[:, :2, 3]
    local = run.ego.in_frame(places)
    for x, y, heading in route[:4]:
        assert np.hypot(*(local - [x, y]).T).min() < 0.1 and abs(heading) < 0.5


def test_objects_that_are_moved_are_rendered_where_they_are(drive):
    """A driver who brakes for the ego vehicle is where his clock says, in the boxes and in the image."""
    run = simulated(drive, cameras=(CAMERA,), width=64, outputs=("rgb", "instance"))
    number = [actor.id for actor in run.traffic.actors].index(CAR)
    for _ in range(10):
        run.step(KEPT)
    run.traffic.reacting[number] = True
    run.traffic.clocks[number] -= 0.7
    run.traffic.poses = run.traffic.tables.poses(run.traffic.clocks)
    run.traffic.present = run.traffic.tables.there(run.traffic.clocks)
    world = run.world()
    assert CAR in world.actors
    np.testing.assert_allclose(world.actors[CAR].pose, run.traffic.poses[number], atol=1e-9)
    recorded = drive.state(run.time, outside="clamp").actors[CAR].pose
    assert np.linalg.norm((world.actors[CAR].pose - recorded)[:3, 3]) > 0.3


def test_a_policy_is_told_how_far_it_can_trust_the_image(drive):
    env = DriveEnv(drive, cameras=(CAMERA,), width=64, validity=True, end_on_collision=False)
    on_path = env.reset(seed=0)[1]["validity"]
    for _ in range(15):
        aside = env.step(np.array([0.5, 0.0], dtype=np.float32))[4]["validity"]
    assert 0.0 <= aside < on_path <= 1.0
    run = env.simulation
    view = drive.view(run.cameras[CAMERA], run.time, ego_to_world=run.ego_to_world)
    assert aside == ViewKnowledge.of_drive(drive).validity(run.world(), view).validity
    assert "validity" not in simulated(drive).facts()
    with pytest.raises(RequestError, match="the simulation has no camera"):
        simulated(drive).view()


def test_the_road_of_a_model_is_what_is_drivable(drive):
    run = simulated(drive)
    roads = [part for part in drive.model.parts if part.name == "road"]
    assert (run.drivable is None) == (not roads)
    if roads:
        assert run.drivable(run.ego_to_world[None, :2, 3]).tolist() == [True]
        assert run.drivable(run.ego_to_world[None, :2, 3] + 60.0 * run.ego_to_world[:2, 1]).tolist() == [False]


# ---- as an environment


def test_gymnasiums_checker_accepts_it(drive):
    check_env(DriveEnv(drive, cameras=(CAMERA,), width=32, seconds=0.5), skip_render_check=True)


def test_the_same_seed_and_actions_give_the_same_observations(drive):
    def episode(seed: int) -> list:
        env = DriveEnv(drive, cameras=(CAMERA,), width=32, seconds=1.0, traffic={"variation": 0.2})
        random = np.random.default_rng(5)
        found = [env.reset(seed=seed)[0]]
        for _ in range(6):
            found.append(env.step(random.uniform([-0.3, -2.0], [0.3, 2.0]).astype(np.float32))[0])
        return found

    one, two = episode(3), episode(3)
    assert all(map(equal, one, two)) and not all(equal(a, b) for a, b in pairwise(one))


def test_a_policy_that_keeps_and_changes_arrays_changes_nothing(drive):
    env = DriveEnv(drive, cameras=(CAMERA,), width=32, seconds=1.0)
    first, info = env.reset(seed=0)
    again = DriveEnv(drive, cameras=(CAMERA,), width=32, seconds=1.0)
    again.reset(seed=0)
    for values in (first["ego"], first["route"], first["boxes"], first["cameras"][CAMERA]["rgb"]):
        values[...] = 99
    info["ego_to_world"][...] = 99.0
    for _ in range(3):
        assert equal(env.step(KEPT)[0], again.step(KEPT)[0])


def test_two_environments_of_one_drive_do_not_disturb_each_other(drive):
    alone, one, other = (DriveEnv(drive, cameras=(), seconds=1.0) for _ in range(3))
    for env in (alone, one, other):
        env.reset(seed=0)
    for _ in range(5):
        other.step(np.array([0.4, -3.0], dtype=np.float32))
        assert equal(one.step(KEPT)[0], alone.step(KEPT)[0])


def test_an_episode_ends_with_its_time_and_a_reset_begins_another(drive):
    env = DriveEnv(drive, cameras=(), seconds=0.5, end_on_collision=False)
    first, _ = env.reset(seed=0)
    ends = [env.step(KEPT)[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]
    with pytest.raises(RequestError, match="the episode is over"):
        env.step(KEPT)
    assert equal(env.reset(seed=0)[0], first)
    env.step(KEPT)
    assert equal(env.reset(seed=0)[0], first), "in the middle"


def test_a_contact_ends_an_episode_and_progress_is_the_reward(drive):
    env = DriveEnv(drive, cameras=(), traffic={"vehicles": "replay"})
    env.reset(seed=0)
    rewards, ended = [], False
    while not ended:
        _, reward, touched, late, info = env.step(np.array([0.0, 3.0], dtype=np.float32))
        rewards.append(reward)
        ended = touched or late
    assert sum(rewards) == pytest.approx(env.simulation.progress, abs=0.3)
    assert touched == bool(info["contacts"])


def test_beyond_the_recording_a_run_goes_on_where_that_is_wanted(drive):
    run = simulated(drive, beyond="go_on", seconds=drive.duration + 0.6, cameras=(CAMERA,), width=32)
    while not run.ended:
        run.step([0.0, -1.0])
    assert run.time > drive.duration and run.observation()["cameras"][CAMERA]["rgb"].shape[1] == 32
    ends = simulated(drive, seconds=drive.duration + 5.0)
    assert ends.length_s <= drive.duration


def test_a_vector_of_environments_shares_one_drive(drive):
    envs = vector_env(drive, 2, cameras=(CAMERA,), width=32, seconds=0.5)
    observation, _ = envs.reset(seed=1)
    assert observation["cameras"][CAMERA]["rgb"].shape[0] == 2
    found = envs.step(np.array([[0.0, 0.0], [0.3, -3.0]], dtype=np.float32))[0]
    assert not np.array_equal(found["ego"][0], found["ego"][1])
    envs.close()


def test_render_gives_the_image_of_the_first_camera(drive):
    env = DriveEnv(drive, render_mode="rgb_array", cameras=(CAMERA,), width=32, seconds=0.5)
    assert env.render() is None
    seen, _ = env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), seen["cameras"][CAMERA]["rgb"])
    blind = DriveEnv(drive, render_mode="rgb_array", cameras=())
    blind.reset(seed=0)
    with pytest.raises(RequestError, match="the environment has no image"):
        blind.render()


@pytest.mark.parametrize("rate", [0.7, 3.0, 7.0, 10.0, 30.0])
def test_no_step_is_beyond_the_recording_and_followed_ones_are_on_the_path(drive, rate):
    run = simulated(drive, rate_hz=rate, recorded_until=100.0)
    while not run.ended:
        run.step(KEPT)
        assert run.offset < 0.02
    assert drive.duration - 1.0 / rate - 0.1 < run.time <= drive.duration + 1e-9
    along = run.route()
    np.testing.assert_allclose(np.linalg.norm(np.diff(along[:, :2], axis=0), axis=1), 2.0, atol=0.05)


def test_the_recorded_acceleration_is_observed(drive):
    run = simulated(drive, recorded_until=100.0)
    speeds, pushes = [], []
    while not run.ended:
        run.step(KEPT)
        speeds.append(run.ego.speed)
        pushes.append(run.ego.acceleration)
    np.testing.assert_allclose(pushes[2:-2], np.gradient(speeds, 0.1)[2:-2], atol=0.15)


# ---- what is refused


@pytest.mark.parametrize("action", [[np.nan, 0.0], [0.0], [0.0, np.inf], "left", None, [[0.0, 0.0]]])
def test_actions_that_are_none_are_refused(drive, action):
    run = simulated(drive)
    with pytest.raises(RequestError, match=r"an action is steering and acceleration: finite numbers of shape \(2,\)"):
        run.step(action)


def test_actions_beyond_the_limits_are_clipped(drive):
    one, other = simulated(drive), simulated(drive)
    one.step([99.0, 99.0])
    other.step([0.6, 3.0])
    assert one.ego == other.ego


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"cameras": ("CAM_NOSE",)}, RequestError, "CAM_NOSE"),
        ({"lidar": "LIDAR_ROOF"}, RequestError, "LIDAR_ROOF"),
        ({"start": 99.0}, RequestError, "a run cannot begin at 99 s"),
        ({"seconds": 0.05}, RequestError, "has no step"),
    ],
)
def test_what_the_drive_does_not_have_is_refused(drive, settings, error, message):
    with pytest.raises(error, match=message):
        simulated(drive, **settings)


def test_without_a_camera_nothing_can_be_trusted():
    with pytest.raises(ValueError, match="'validity' is that of an image or a scan"):
        SimulationSettings(cameras=(), validity=True)


def test_edits_that_do_not_fit_and_unknown_render_modes_are_refused(drive):
    with pytest.raises(ConfigError, match="no editable track"):
        DriveEnv(drive, edits=[{"remove": {"track": "nobody"}}])
    with pytest.raises(RequestError, match="there is no render mode 'human'"):
        DriveEnv(drive, render_mode="human", cameras=())


def test_an_edited_drive_is_driven_in(drive):
    gone = DriveEnv(drive, edits=[{"remove": {"track": CAR}}], cameras=())
    assert CAR not in gone.reset(seed=0)[1]["objects"]
    assert CAR in DriveEnv(drive, cameras=()).reset(seed=0)[1]["objects"]


def test_without_gymnasium_the_environment_says_what_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "drivesplat.simulate.env")
    with pytest.raises(ImportError, match="needs Gymnasium"):
        _ = drivesplat.simulate.DriveEnv
    assert drivesplat.simulate.Simulation is Simulation
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = drivesplat.simulate.Nothing


def test_the_examples_of_the_guide_run(drive, tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    (tmp_path / "results/demo").symlink_to(drive.folder.resolve().parent)
    monkeypatch.chdir(tmp_path)
    examples = re.findall(r"```python\n(.*?)```", (REPOSITORY / "docs/closed_loop.md").read_text(), flags=re.DOTALL)
    names: dict = {}
    for example in examples:
        if "scan_validity" not in example:  # needs a method that renders LiDAR: see test_scan_validity
            exec(example, names)
    assert examples and names["image"].shape == (225, 400, 3)


def test_the_example_of_a_camera_policy_drives_along_the_path(drive):
    seen = simulated(drive, cameras=(CAMERA,), width=64, seconds=1.0).observation()
    steering, push = policy_of("examples.camera_policy:CameraPolicy", {}).act(seen, {})
    assert abs(steering) < 0.6 and push == 0.0


def test_the_package_gives_the_environment():
    assert drivesplat.simulate.DriveEnv.__name__ == "DriveEnv" and issubclass(DriveEnv, gymnasium.Env)
