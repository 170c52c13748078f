"""Rigid transforms as 4x4 matrices, float64, applied to column vectors."""

import numpy as np


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """The transforms (..., 4, 4) of rotation matrices (..., 3, 3), or a common one, and translations (..., 3)."""
    transform = np.zeros((*np.shape(translation)[:-1], 4, 4))
    transform[..., :3, :3], transform[..., :3, 3], transform[..., 3, 3] = rotation, translation, 1.0
    return transform


def inverse(transform: np.ndarray) -> np.ndarray:
    """The inverse of rigid transforms (..., 4, 4)."""
    rotation_t = np.swapaxes(transform[..., :3, :3], -1, -2)
    return rigid(rotation_t, -(rotation_t @ transform[..., :3, 3:])[..., 0])


def apply(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    """`points` (n, 3) transformed by `transform` (4, 4)."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def interpolate(start: np.ndarray, end: np.ndarray, fraction: float) -> np.ndarray:
    """The pose (4, 4) at `fraction` between two poses: linear position, slerp rotation.

    Outside [0, 1] the motion is extrapolated.
    """
    from scipy.spatial.transform import Rotation  # here: planning imports this module, and scipy takes long

    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    rotation = start[:3, :3] @ Rotation.from_rotvec(fraction * turn).as_matrix()
    return rigid(rotation, (1.0 - fraction) * start[:3, 3] + fraction * end[:3, 3])


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) of the cross product with a vector (3,): cross_matrix(a) @ b is a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def path_lengths(poses: np.ndarray) -> np.ndarray:
    """Metres (n,) from the first of successive poses (n, 4, 4) to each, along the path."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
