"""The horizon in an image: pixels below it cannot show the sky."""

import math

import numpy as np
from jaxtyping import Bool, Float

from drivesplat.scene.images import upward_rays

MARGIN = math.radians(1.0)
"""Minimum angle in radians of a ray below the horizontal plane. Allows for errors of recorded poses."""


def below_horizon(
    K: Float[np.ndarray, "3 3"], camera_to_world: Float[np.ndarray, "4 4"], size: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """The pixels of an image of `size` (width, height) whose rays point more than MARGIN below the horizontal plane.
    `K` is in continuous pixels; the camera is an OpenCV one, and the world's z points up.

    >>> K = np.array([[100.0, 0.0, 2.0], [0.0, 100.0, 2.0], [0.0, 0.0, 1.0]])
    >>> level = np.eye(4)
    >>> level[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    >>> below_horizon(K, level, (1, 6))[:, 0].tolist()  # pixels of 0.57 degrees
    [False, False, False, False, True, True]
    """
    return upward_rays(size, K, camera_to_world) < -math.sin(MARGIN)
