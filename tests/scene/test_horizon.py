"""The horizon in images of cameras that pitch and roll."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.scene.images import HORIZON_MARGIN, below_horizon
from drivesplat.scene.rigid import rigid

SIZE = (64, 48)
K = np.array([[60.0, 0.0, 30.0], [0.0, 58.0, 21.0], [0.0, 0.0, 1.0]])
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera to world of a level camera that looks along the world's x."""


def camera(pitch: float = 0.0, roll: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """The pose of a camera 1.6 m above the ground; angles in degrees, a positive pitch looks down."""
    turned = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
    return rigid(turned @ FORWARD, np.array([5.0, -3.0, 1.6]))


@pytest.mark.parametrize("angles", [{}, {"pitch": 12.0}, {"pitch": -8.0, "yaw": 130.0}, {"roll": 25.0, "pitch": 3.0}])
def test_far_points_around_the_horizon_are_on_their_side(angles):
    """Points a kilometre away, a little more and a little less than the margin below the camera's height."""
    pose = camera(**angles)
    mask = below_horizon(K, pose, SIZE)
    assert mask.shape == (48, 64) and mask.any() and not mask.all()
    seen = 0
    for azimuth in np.radians(np.arange(0.0, 360.0, 2.0)):
        for elevation, expected in ((-HORIZON_MARGIN - 0.02, True), (-HORIZON_MARGIN + 0.02, False)):
            way = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
            x, y, z = pose[:3, :3].T @ np.array(way) * 1000.0
            if z <= 0.0:
                continue
            column, row = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
            if 0.0 <= column < SIZE[0] and 0.0 <= row < SIZE[1]:
                assert mask[int(row), int(column)] == expected
                seen += 1
    assert seen > 10


def test_a_camera_that_looks_up_sees_nothing_below_and_one_that_looks_down_nothing_else():
    assert not below_horizon(K, camera(pitch=-60.0), SIZE).any()
    assert below_horizon(K, camera(pitch=60.0), SIZE).all()
