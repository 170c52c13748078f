"""Paths of a film: through the recorded poses, at the drive's speed, smooth, and beside it by what was asked."""

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.render import TrajectorySettings
from drivesplat.trajectories.camera_path import CameraPath, film_intrinsics, film_path, smooth_poses

START_US = 1_532_402_927_612_460
RADIUS, SPEED = 20.0, 8.0
RECORDED = TrajectorySettings()
CAMERA_TO_EGO = rigid(
    Rotation.from_euler("xyz", [1.0, 2.0, -3.0], degrees=True).as_matrix()
    @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    np.array([1.7, 0.1, 1.5]),
)
"""A camera that looks forward, a little askew."""

Motion = Callable[[float], np.ndarray]


def on_a_circle(seconds: float) -> np.ndarray:
    """The ego pose of a steady left turn about the origin."""
    turn = SPEED / RADIUS * seconds
    at = RADIUS * np.array([np.sin(turn), -np.cos(turn), 0.0])
    return rigid(Rotation.from_euler("z", turn).as_matrix(), at)


def on_a_hilly_bend(seconds: float) -> np.ndarray:
    """A turn that winds, climbs and leans."""
    angles = [0.05 * np.sin(seconds), -0.1 * np.cos(0.7 * seconds), 0.8 * np.sin(0.5 * seconds)]
    at = np.array([9.0 * seconds, 6.0 * np.sin(0.4 * seconds), 0.6 * seconds])
    return rigid(Rotation.from_euler("xyz", angles).as_matrix(), at)


def straight_on(seconds: float) -> np.ndarray:
    return rigid(np.eye(3), np.array([SPEED * seconds, 0.0, 0.0]))


def standing(seconds: float) -> np.ndarray:
    return rigid(Rotation.from_euler("z", 1.0).as_matrix(), np.array([3.0, 4.0, 5.0]))


def frame_at(microseconds: int, motion: Motion, camera: str = "CAM_FRONT") -> Frame:
    ego_to_world = motion(microseconds * 1e-6)
    intrinsics = np.array([[1266.4, 0.0, 816.3], [0.0, 1266.4, 491.5], [0.0, 0.0, 1.0]])
    return Frame(
        camera, START_US + microseconds, f"{camera} {microseconds}.jpg", 1600, 900, intrinsics,
        ego_to_world @ CAMERA_TO_EGO, ego_to_world, False, 0, str(microseconds),
    )  # fmt: skip


def scene_of(frames: list[Frame]) -> Scene:
    return Scene("bend", "made", "v1", "", np.zeros(3), np.array([START_US]), tuple(frames), (), (), "made", 2.0)


def drive(motion: Motion, seconds: float = 10.0, rate: float = 2.0) -> Scene:
    """A drive with `rate` images a second."""
    return scene_of([frame_at(round(i / rate * 1e6), motion) for i in range(int(seconds * rate) + 1)])


def film(scene: Scene, fps: int = 30, offset: TrajectorySettings = RECORDED) -> CameraPath:
    return film_path(scene, "CAM_FRONT", fps, offset)


def true_poses(path: CameraPath, motion: Motion) -> np.ndarray:
    """The ego where it really was at a film's times."""
    return np.stack([motion((timestamp - START_US) * 1e-6) for timestamp in path.timestamps.tolist()])


@pytest.mark.parametrize("motion", [on_a_circle, on_a_hilly_bend, standing])
def test_a_film_passes_through_the_recorded_poses(motion):
    scene = drive(motion)
    path = film(scene, fps=10)
    recorded = np.stack([frame.camera_to_world for frame in scene.frames])
    np.testing.assert_array_equal(path.timestamps[::5], [frame.timestamp for frame in scene.frames])
    np.testing.assert_allclose(path.camera_to_world[::5], recorded, atol=1e-9)


def test_a_film_passes_through_images_at_uneven_times():
    times = START_US + np.cumsum(np.random.default_rng(0).integers(20_000, 130_000, 60))
    poses = np.stack([on_a_hilly_bend((t - START_US) * 1e-6) for t in times])
    np.testing.assert_allclose(smooth_poses(times, poses, times), poses, atol=1e-9)


@pytest.mark.parametrize("fps", [1, 7, 24, 30, 240])
@pytest.mark.parametrize("microseconds", [1, 41_666, 41_667, 1_000_000, 19_266_481])
def test_the_frames_of_a_film_are_evenly_spaced_without_drift_and_within_the_recording(fps, microseconds):
    path = film(scene_of([frame_at(0, straight_on), frame_at(microseconds, straight_on)]), fps)
    assert len(path) == int(Fraction(microseconds * fps, 1_000_000)) + 1
    exact = [START_US + Fraction(k * 1_000_000, fps) for k in range(len(path))]
    assert all(abs(t - e) <= Fraction(1, 2) for t, e in zip(path.timestamps.tolist(), exact, strict=True))
    assert path.timestamps[0] == START_US and path.timestamps[-1] <= START_US + microseconds


def test_a_film_runs_at_the_speed_of_the_drive():
    centers = film(drive(straight_on, rate=12.0), fps=25).camera_to_world[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(np.diff(centers, axis=0), axis=1), SPEED / 25, rtol=1e-4)


def test_speed_acceleration_and_turn_rate_do_not_jump_at_the_recorded_poses():
    """Halving the time between poses halves the largest step of what is continuous, and of nothing else."""
    times = np.arange(0, 10_000_000, 333_000)
    poses = np.stack([on_a_hilly_bend(t * 1e-6) for t in times])

    def largest_steps(microseconds: int) -> np.ndarray:
        pose = smooth_poses(times, poses, np.arange(0, times[-1], microseconds))
        rate = 1e6 / microseconds
        speed = np.diff(pose[:, :3, 3], axis=0) * rate
        between = np.swapaxes(pose[:-1, :3, :3], -1, -2) @ pose[1:, :3, :3]
        turn_rate = Rotation.from_matrix(between).as_rotvec() * rate
        quantities = [speed, turn_rate, np.diff(speed, axis=0) * rate, np.diff(turn_rate, axis=0) * rate]
        return np.array([np.abs(np.diff(values, axis=0)).max() for values in quantities])

    assert (largest_steps(4_000) < 0.6 * largest_steps(8_000)).all()


@pytest.mark.parametrize(("lateral", "vertical"), [(2.0, 0.0), (-3.5, 0.0), (0.0, 1.25), (2.0, -0.5)])
def test_every_frame_is_displaced_by_the_offset(lateral, vertical):
    """Perpendicular to the heading of the turning car, not along one direction of the world."""
    scene = drive(on_a_circle)
    recorded, path = film(scene), film(scene, offset=TrajectorySettings(lateral=lateral, vertical=vertical))
    ego = true_poses(path, on_a_circle)[:, :3, :3]
    aside = np.einsum("nij,ni->nj", ego, path.camera_to_world[:, :3, 3] - recorded.camera_to_world[:, :3, 3])
    np.testing.assert_allclose(aside, np.broadcast_to([0.0, lateral, vertical], aside.shape), atol=1e-6)
    np.testing.assert_array_equal(path.camera_to_world[:, :3, :3], recorded.camera_to_world[:, :3, :3])


def test_the_left_of_a_left_turn_is_its_inside():
    centers = film(drive(on_a_circle), offset=TrajectorySettings(lateral=2.0)).camera_to_world[:, :3, 3]
    ahead, left, _ = CAMERA_TO_EGO[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(centers[:, :2], axis=1), np.hypot(RADIUS - left - 2.0, ahead), atol=5e-3)


def test_on_a_banked_road_lateral_is_the_left_of_the_ego_vehicle():
    scene = drive(on_a_hilly_bend, rate=10.0)
    recorded, path = film(scene, fps=10), film(scene, fps=10, offset=TrajectorySettings(lateral=2.0))
    left = np.stack([frame.ego_to_world[:3, 1] for frame in scene.frames])
    np.testing.assert_allclose(
        path.camera_to_world[:, :3, 3] - recorded.camera_to_world[:, :3, 3], 2.0 * left, atol=1e-9
    )


@pytest.mark.parametrize("yaw", [90.0, -30.0, 180.0])
def test_yaw_turns_the_camera_to_the_left_about_its_centre(yaw):
    scene = drive(on_a_circle)
    recorded, path = film(scene), film(scene, offset=TrajectorySettings(yaw=yaw))
    np.testing.assert_array_equal(path.camera_to_world[:, :3, 3], recorded.camera_to_world[:, :3, 3])
    before, after = recorded.camera_to_world[:, :3, 2], path.camera_to_world[:, :3, 2]
    headings = np.degrees(np.arctan2(after[:, 1], after[:, 0]) - np.arctan2(before[:, 1], before[:, 0]))
    np.testing.assert_allclose((headings - yaw + 180.0) % 360.0 - 180.0, 0.0, atol=1e-6)
    np.testing.assert_allclose(path.camera_to_world[:, 2, :3], recorded.camera_to_world[:, 2, :3], atol=1e-9)


def test_a_standing_vehicle_gives_one_pose():
    path = film(drive(standing))
    expected = np.broadcast_to(standing(0) @ CAMERA_TO_EGO, path.camera_to_world.shape)
    np.testing.assert_allclose(path.camera_to_world, expected, atol=1e-9)


def test_the_error_for_an_unknown_camera_names_the_known_ones():
    scene = scene_of([frame_at(0, standing, "CAM_BACK"), frame_at(9, standing, "CAM_LEFT")])
    with pytest.raises(DatasetError, match=r"bend .*CAM_FRONT.*CAM_BACK, CAM_LEFT"):
        film(scene)


@pytest.mark.parametrize(("width", "height"), [(1600, 900), (1920, 1080), (800, 800), (320, 90)])
def test_without_a_field_of_view_a_film_is_the_scaled_image_cropped_or_padded_vertically(width, height):
    frame = frame_at(0, standing)
    k = film_intrinsics(frame, width, height, None)
    scale = width / 1600
    # integer coordinates at pixel centres put the recorded principal point half a pixel nearer the corner
    expected = [
        [1266.4 * scale, 0.0, (816.3 + 0.5) * scale],
        [0.0, 1266.4 * scale, height / 2 + (491.5 + 0.5 - 450.0) * scale],
        [0.0, 0.0, 1.0],
    ]
    np.testing.assert_allclose(k, expected, atol=1e-9)
