"""Poses over time."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.scene.pose_path import PosePath
from drivesplat.scene.rigid import interpolate, rigid


def pose(yaw: float, x: float) -> np.ndarray:
    return rigid(Rotation.from_euler("z", yaw, degrees=True).as_matrix(), np.array([x, 2.0, 0.0]))


START = 1_700_000_000_000_000
PATH = PosePath(START + np.array([0, 100, 400]), np.stack([pose(0.0, 0.0), pose(30.0, 1.0), pose(90.0, 7.0)]))


@pytest.mark.parametrize("time, i, fraction", [(0, 0, 0.0), (25, 0, 0.25), (100, 1, 0.0), (250, 1, 0.5), (400, 1, 1.0)])
def test_between_two_poses_position_is_linear_and_rotation_slerp(time, i, fraction):
    expected = interpolate(PATH.poses[i], PATH.poses[i + 1], fraction)
    np.testing.assert_allclose(PATH.at(np.array([START + time]))[0], expected, atol=1e-9)


def test_outside_the_known_times_the_nearest_pose_holds():
    found = PATH.at(START + np.array([-50, 500]))
    np.testing.assert_allclose(found, PATH.poses[[0, 2]], atol=1e-12)


def test_a_single_pose_holds_at_all_times():
    found = PosePath(np.array([START]), PATH.poses[:1]).at(START + np.array([-5, 0, 5]))
    np.testing.assert_array_equal(found, np.repeat(PATH.poses[:1], 3, axis=0))
