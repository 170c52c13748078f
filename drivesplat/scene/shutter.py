"""Rolling shutters: when each line of an image is read, and how the camera moves meanwhile.

Lines are read one after the other, and a pixel at (x, y) of an image (w, h) at

    t = readout_s[0] * (x / w - 1/2) + readout_s[1] * (y / h - 1/2) + readout_s[2]

seconds after the image's timestamp.
A point is therefore seen where it is at the time of its own line. `displaced` moves each point there, so that a camera
without rolling shutter at the timestamp's pose sees the same image. The time is found by one Newton step from the line
where the point is at the timestamp, and velocities are constant during the readout. Seiskari et al. 2024 (Gaussian
Splatting on the Move, arXiv 2403.13327) and Hess et al. 2025 (SplatAD, arXiv 2411.16816) move projected means in the
same way; the shape of a Gaussian is not sheared.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from drivesplat.scene.rigid import cross_matrix
from drivesplat.scene.sensors import Camera

Array = TypeVar("Array")
"""A numpy array or a torch tensor."""
NEAR = 0.1
"""Depth in metres up to which points are not displaced: no rasterizer shows them."""
OUTSIDE = 1.5
"""Times beyond the first and the last line are limited to the image enlarged by this factor."""
MAX_RATE = 0.5
"""Largest speed of a point over the image, in units of the readout's speed. Faster points are no longer displaced
correctly: a line that keeps up with a point would show it for ever."""


@dataclass(frozen=True)
class Shutter:
    """The rolling shutter of an image. `readout_s` (3,): seconds from the left edge of the image to the right one, and
    from the top edge to the bottom one, negative if read the other way; and from the image's timestamp to the middle of
    the readout. `velocity` (6,): linear (m/s), then angular velocity (rad/s) of the camera at the timestamp, along the
    camera's axes (OpenCV)."""

    readout_s: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "6"]

    @property
    def motion(self) -> np.ndarray:
        """The matrix (3, 4) that maps a resting point (x, y, z, 1) in the camera's axes to its velocity (m/s) there."""
        return -np.column_stack([cross_matrix(self.velocity[3:]), self.velocity[:3]])


def readout_of(camera: Camera) -> np.ndarray:
    """The first two of `Shutter.readout_s`; zeros for a global shutter, and where time or direction is unknown."""
    seconds = camera.readout_s or 0.0
    along = {"right": (1.0, 0.0), "left": (-1.0, 0.0), "down": (0.0, 1.0), "up": (0.0, -1.0)}
    return seconds * np.array(along.get(camera.readout_direction or "", (0.0, 0.0)))


def displaced(
    points: Array, readout_s: Array, motion: Array, intrinsics: Array, size: tuple[int, int], own: Array | None = None
) -> Array:
    """Where `points` (n, 3) in the camera's axes at the image's timestamp are at the time of their line, in the axes of
    the camera at that time: (n, 3) metres.

    `readout_s` and `motion` are those of `Shutter`, `intrinsics` (3, 3) are continuous for an image of `size` (width,
    height), `own` (n, 3) the points' own velocities (m/s) along the camera's axes. numpy arrays or torch tensors.
    """
    x, y = (intrinsics[i] / length - 0.5 * intrinsics[2] for i, length in enumerate(size))
    across = readout_s[0] * x + readout_s[1] * y + readout_s[2] * intrinsics[2]
    moving = points @ motion[:, :3].T + motion[:, 3]
    if own is not None:
        moving = moving + own
    depth = points[:, 2]
    deep, limit = depth.clip(NEAR), 0.5 * OUTSIDE * abs(readout_s[:2]).sum() + abs(readout_s[2])
    time = (points @ across / deep).clip(-limit, limit)  # seconds from the timestamp until the point's line is read
    rate = ((moving @ across - time * moving[:, 2]) / deep).clip(-MAX_RATE, MAX_RATE)
    time = (time / (1.0 - rate)).clip(-limit, limit) * (depth > NEAR)
    return points + time[:, None] * moving


def where_seen(
    points: np.ndarray,
    shutter: Shutter | None,
    camera_to_world: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    own: np.ndarray | None = None,
) -> np.ndarray:
    """World points (n, 3) moved so that a camera without rolling shutter sees them where this one does; `own` (n, 3)
    are their velocities in the world. Other arguments are those of `displaced`. Without `shutter` nothing moves."""
    if shutter is None:
        return points
    rotation, center = camera_to_world[:3, :3], camera_to_world[:3, 3]
    along_axes = None if own is None else own @ rotation
    in_camera = (points - center) @ rotation
    return displaced(in_camera, shutter.readout_s, shutter.motion, intrinsics, size, along_axes) @ rotation.T + center
