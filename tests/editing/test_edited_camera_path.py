"""The camera path of an edited drive: recorded, offset, faster or slower."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.editing.ego import edited_camera_path
from drivesplat.errors import ConfigError, DatasetError
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.edit import Edit
from drivesplat.settings.render import TrajectorySettings
from drivesplat.trajectories.camera_path import CameraPath, film_path, recorded_frames

START = 1_532_402_927_612_460
SPEED, RADIUS, FPS = 8.0, 20.0, 10
CAMERA_TO_EGO = rigid(
    Rotation.from_euler("xyz", [1.0, 2.0, -3.0], degrees=True).as_matrix()
    @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    np.array([1.7, 0.1, 1.5]),
)
DELAY = 0.04
"""Seconds from the scene's first image, another camera's, to the front camera's."""


def straight(seconds: float) -> np.ndarray:
    return rigid(np.eye(3), np.array([SPEED * seconds, 0.0, 0.0]))


def circle(seconds: float) -> np.ndarray:
    """A left turn about the origin."""
    turn = SPEED / RADIUS * seconds
    return rigid(Rotation.from_euler("z", turn).as_matrix(), RADIUS * np.array([np.sin(turn), -np.cos(turn), 0.0]))


def scene_of(motion) -> Scene:
    """Ten seconds at 12 Hz."""

    def frame(camera: str, seconds: float) -> Frame:
        ego = motion(seconds)
        time = START + round(seconds * 1e6)
        return Frame(camera, time, "", 16, 9, np.eye(3), ego @ CAMERA_TO_EGO, ego, False, 0, "")

    frames = [frame("CAM_FRONT", DELAY + i / 12) for i in range(121)]
    frames.append(frame("CAM_BACK", 0.0))
    return Scene("drive", "made", "v1", "", np.zeros(3), np.array([START]), tuple(frames), (), (), "made", 2.0)


def edited(motion, *ego: dict) -> CameraPath:
    edit = Edit.model_validate({"steps": [{"ego": step} for step in ego]})
    return edited_camera_path(scene_of(motion), "CAM_FRONT", FPS, edit, "")


def cars(path: CameraPath) -> np.ndarray:
    """The poses (n, 4, 4) of the car that carries the camera."""
    return path.camera_to_world @ inverse(CAMERA_TO_EGO)


def seconds(path: CameraPath) -> np.ndarray:
    return (path.timestamps - START) * 1e-6


@pytest.mark.parametrize("motion", [straight, circle])
def test_without_ego_steps_the_camera_follows_the_recorded_path(motion):
    scene = scene_of(motion)
    path = edited_camera_path(
        scene, "CAM_FRONT", FPS, Edit.model_validate({"steps": [{"stop": {"track": "x", "at": 1}}]}), ""
    )
    recorded = film_path(scene, "CAM_FRONT", FPS, TrajectorySettings())
    np.testing.assert_array_equal(path.timestamps, recorded.timestamps)
    np.testing.assert_array_equal(path.camera_to_world, recorded.camera_to_world)


@pytest.mark.parametrize("motion", [straight, circle])
def test_a_lateral_offset_equals_that_of_a_film_trajectory(motion):
    beside = film_path(scene_of(motion), "CAM_FRONT", FPS, TrajectorySettings(lateral=2.0))
    path = edited(motion, {"lateral": 1.5}, {"lateral": 0.5})
    np.testing.assert_array_equal(path.timestamps, beside.timestamps)
    np.testing.assert_allclose(path.camera_to_world, beside.camera_to_world, atol=1e-9)


@pytest.mark.parametrize("factor", [1.25, 2.0])
def test_the_film_of_a_faster_camera_ends_where_the_recorded_path_does(factor):
    path = edited(straight, {"speed": factor})
    assert len(path) == int(10.0 / factor * FPS) + 1
    np.testing.assert_allclose(cars(path)[:, 0, 3], SPEED * (DELAY + factor * (seconds(path) - DELAY)), atol=1e-4)
    assert cars(path)[-1, 0, 3] == pytest.approx(SPEED * (10.0 + DELAY), abs=1e-4)


def test_ego_speeds_change_smoothly_and_multiply():
    path = edited(
        straight, {"speed": 0.5, "start": 2.0, "duration": 2.0}, {"speed": 0.5, "start": 6.0, "duration": 2.0}
    )
    at = seconds(path)
    driven = np.interp([2.0, 4.0, 6.0, 8.0, 9.0], at, cars(path)[:, 0, 3])
    np.testing.assert_allclose(driven, SPEED * np.array([2.0, 3.5, 4.5, 5.25, 5.5]), atol=0.01)


@pytest.mark.parametrize("motion", [straight, circle])
def test_in_a_lane_change_the_ego_vehicle_points_along_its_motion(motion):
    path = edited(motion, {"lateral": 3.5, "start": 3.0, "duration": 3.0})
    recorded = film_path(scene_of(motion), "CAM_FRONT", FPS, TrajectorySettings()).camera_to_world
    early = seconds(path) <= 3.0
    np.testing.assert_allclose(path.camera_to_world[early], recorded[early], atol=1e-6)
    beside = film_path(scene_of(motion), "CAM_FRONT", FPS, TrajectorySettings(lateral=3.5)).camera_to_world
    np.testing.assert_allclose(path.camera_to_world[seconds(path) >= 6.0], beside[seconds(path) >= 6.0], atol=1e-6)
    car = cars(path)
    ahead = np.einsum("ni,ni->n", (car[2:] - car[:-2])[:, :3, 3], car[1:-1, :3, 0])
    aside = np.einsum("ni,ni->n", (car[2:] - car[:-2])[:, :3, 3], car[1:-1, :3, 1])
    assert np.degrees(np.abs(np.arctan2(aside, ahead))).max() < 0.5
    veers = np.degrees(
        np.abs(
            Rotation.from_matrix(np.swapaxes(recorded[:, :3, :3], 1, 2) @ path.camera_to_world[:, :3, :3]).magnitude()
        )
    )
    assert veers.max() > 12.0


def test_an_unknown_camera_is_refused():
    with pytest.raises(DatasetError, match="no image of camera CAM_LEFT"):
        edit = Edit.model_validate({"steps": [{"ego": {"speed": 2}}]})
        edited_camera_path(scene_of(straight), "CAM_LEFT", FPS, edit, "")


def test_a_step_that_starts_after_the_drive_is_refused():
    scene = scene_of(straight)
    end = scene.seconds(recorded_frames(scene, "CAM_FRONT")[-1].timestamp)
    edit = Edit.model_validate({"steps": [{"ego": {"lateral": 1}}, {"ego": {"speed": 0.5, "start": 100.0}}]})
    with pytest.raises(
        ConfigError, match=rf"^here, step 2 \(ego\): 'start' is not before the end of the drive \({end:.2f} s\)$"
    ):
        edited_camera_path(scene, "CAM_FRONT", FPS, edit, "here")
