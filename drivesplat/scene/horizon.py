"""The horizon in an image: pixels below it cannot show the sky."""

import math

import numpy as np
from jaxtyping import Bool, Float

MARGIN = math.radians(1.0)
"""Angle by which a ray counts as below the horizon at least: recorded poses pitch, and are not exact."""


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
    width, height = size
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=2)
    of_pixel = np.linalg.inv(K)
    rays = pixels @ of_pixel[:, :2].T + of_pixel[:, 2]
    return rays @ camera_to_world[2, :3] < -math.sin(MARGIN) * np.linalg.norm(rays, axis=2)
