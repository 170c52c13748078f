"""Rolling shutters: the motion of the camera during the readout, and where points are seen meanwhile."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.scene.recorded_shutters import shutter_of, shutters
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.sensors import Camera
from drivesplat.scene.shutter import Shutter, displaced, readout_of, where_seen

SIZE = (640, 360)
K = np.array([[500.0, 0.0, 310.0], [0.0, 520.0, 190.0], [0.0, 0.0, 1.0]])
MOUNT = rigid(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([1.7, 0.4, 1.5]))
START = 1_700_000_000_000_000


def camera(seconds: float | None = 0.04, direction: str | None = "down", name: str = "FRONT") -> Camera:
    return Camera(name, *SIZE, K, np.zeros(5), seconds, direction)


def ego_at(seconds: float) -> np.ndarray:
    """An ego vehicle that brakes in a bend."""
    turned = Rotation.from_euler("z", 0.4 * seconds + 0.3).as_matrix()
    return rigid(turned, np.array([12.0 * seconds - 0.8 * seconds**2, 3.0 * seconds, 0.1 * seconds]))


def scene_of(*cameras: Camera, times: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3)) -> Scene:
    frames = [
        Frame(
            lens.name, START + round(1e6 * time), "", *SIZE, K, ego_at(time) @ MOUNT, ego_at(time), True, i, f"{i}",
            readout_middle_s=0.003,
        )
        for lens in cameras
        for i, time in enumerate(times)
    ]  # fmt: skip
    stamps = np.array([START + round(1e6 * time) for time in times])
    return Scene("a", "d", "v", "", np.zeros(3), stamps, tuple(frames), (), (), "d", 10.0, cameras=cameras)


def exactly_seen(points: np.ndarray, shutter: Shutter, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) and depths (n,) of points (n, 3) in the camera's axes, each at the time of its own line, found by
    trying the time until it is that of the line."""
    velocity, turning = shutter.velocity[:3], shutter.velocity[3:]
    times = np.zeros(len(points))
    for _ in range(80):
        turned = Rotation.from_rotvec(np.outer(times, turning)).as_matrix()
        relative = points + times[:, None] * (own - velocity)
        at = np.einsum("nji,nj->ni", turned, relative)
        pixels = (at @ K.T)[:, :2] / at[:, 2:]
        times = (pixels / SIZE - 0.5) @ shutter.readout_s[:2] + shutter.readout_s[2]
    return pixels, at[:, 2]


@pytest.mark.parametrize(
    ("direction", "expected"),
    [("down", (0, 1)), ("up", (0, -1)), ("right", (1, 0)), ("left", (-1, 0)), (None, (0, 0))],
)
def test_the_readout_runs_from_edge_to_edge(direction, expected):
    assert readout_of(camera(0.04, direction)).tolist() == [0.04 * e for e in expected]
    assert not readout_of(camera(None, direction)).any() and not readout_of(camera(0.0, direction)).any()


def test_the_velocity_is_that_of_the_camera_along_its_own_axes():
    scene = scene_of(camera())
    for found, frame in zip(shutters(scene), scene.frames, strict=True):
        time = (frame.timestamp - START) * 1e-6
        before, after = (ego_at(time + step) @ MOUNT for step in (-1e-4, 1e-4))
        to_camera = frame.camera_to_world[:3, :3].T
        linear = to_camera @ (after[:3, 3] - before[:3, 3]) / 2e-4
        angular = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec() / 2e-4
        np.testing.assert_allclose(found.velocity[:3], linear, atol=0.1)  # braking, seen from neighbours 0.1 s apart
        np.testing.assert_allclose(found.velocity[3:], angular, atol=1e-6)
        assert found.readout_s.tolist() == [0.0, 0.04, 0.003]
    inner = [frame for frame in scene.frames if 0 < frame.sample_index < 3]
    for frame, found in zip(inner, shutters(scene, inner), strict=True):
        assert np.array_equal(found.velocity, shutter_of(scene, frame).velocity)


@pytest.mark.parametrize(
    ("cameras", "times", "known"),
    [
        ([camera(None)], (0.0, 0.1), [False, False]),
        ([camera(0.04, None)], (0.0, 0.1), [False, False]),
        ([camera()], (0.0,), [False]),
        ([camera()], (0.0, 5.0), [False, False]),
        ([camera()], (0.0, 0.5), [True, True]),
        ([camera(), camera(0.0, "down", "REAR")], (0.0, 0.1), [True, True, False, False]),
    ],
)
def test_a_shutter_needs_a_readout_and_two_poses_near_in_time(cameras, times, known):
    assert [shutter is not None for shutter in shutters(scene_of(*cameras, times=times))] == known


@pytest.mark.parametrize("readout", [(0.0, 0.04, 0.0), (-0.044, 0.0, -0.003)])
@pytest.mark.parametrize("velocity", [(10, 0, 0, 0, 0, 0), (1, 0, 12, 0.05, 0.4, 0.05)])
@pytest.mark.parametrize("moves", [False, True])
def test_points_are_seen_where_they_are_at_the_time_of_their_line(readout, velocity, moves):
    random = np.random.default_rng(0)
    shutter = Shutter(np.array(readout), np.array(velocity, dtype=float))
    depth = random.uniform(4.0, 60.0, 2000)
    pixels = random.uniform(0.0, 1.0, (2000, 2)) * SIZE
    points = np.column_stack([pixels, np.ones(2000)]) @ np.linalg.inv(K).T * depth[:, None]
    own = random.uniform(-8.0, 8.0, (2000, 3)) * moves
    expected, expected_depth = exactly_seen(points, shutter, own)
    found = displaced(points, shutter.readout_s, shutter.motion, K, SIZE, own)
    seen = (found @ K.T)[:, :2] / found[:, 2:]
    assert np.abs(expected - pixels).max() > 10.0, "the shutter matters"
    errors = np.abs(seen - expected).max(axis=1)
    assert np.median(errors) < 0.05 and errors.max() < 1.5
    np.testing.assert_allclose(found[:, 2], expected_depth, atol=0.02)


def test_world_points_are_moved_as_the_camera_sees_them():
    scene = scene_of(camera())
    frame, shutter = scene.frames[1], shutter_of(scene, scene.frames[1])
    ahead = np.random.default_rng(0).uniform([-4, -2, 5], [4, 2, 30], (50, 3))
    pose, own = frame.camera_to_world, np.tile([0.0, 3.0, 0.0], (50, 1))
    world = ahead @ pose[:3, :3].T + pose[:3, 3]
    moved = where_seen(world, shutter, pose, K, SIZE, own)
    expected = displaced(ahead, shutter.readout_s, shutter.motion, K, SIZE, own @ pose[:3, :3])
    to_camera = inverse(pose)
    np.testing.assert_allclose(moved @ to_camera[:3, :3].T + to_camera[:3, 3], expected, atol=1e-9)
    assert where_seen(world, None, pose, K, SIZE) is world
