"""Poses of drive folders as matrices, and the ego vehicle's path."""

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import checked_pose
from drivesplat.readers.drive.format import Drive, Pose
from drivesplat.scene.rigid import interpolate, rigid

TOLERANCE = 1e-3
"""Largest deviation of a rotation matrix times its transpose from the identity."""


def matrix_of(pose: Pose, record: str = "pose") -> np.ndarray:
    """A pose as a transform (4, 4). Raises DatasetError naming `record` if it is not rigid."""
    if len(pose.rotation) == 4:
        return checked_pose(pose.translation, pose.rotation, record)
    rotation = np.array(pose.rotation, dtype=np.float64)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > TOLERANCE:
        raise DatasetError(f"{record}: its rotation is no rotation matrix; its rows are no orthogonal unit vectors")
    if np.linalg.det(rotation) < 0:
        raise DatasetError(f"{record}: its rotation is mirrored (determinant -1); one axis points the wrong way")
    return rigid(rotation, np.array(pose.translation))


class EgoPath:
    """The ego vehicle's path in the drive's world."""

    def __init__(self, drive: Drive):
        self._times = np.array([pose.timestamp for pose in drive.ego_poses], dtype=np.int64)
        self._poses = [matrix_of(pose) for pose in drive.ego_poses]

    def __len__(self) -> int:
        return len(self._times)

    def at(self, time: int) -> np.ndarray:
        """Ego to world (4, 4) at a time: the given pose, or linear position and slerp between two. Outside the given
        times, which faults exclude for all recordings, the nearest pose."""
        after = int(np.searchsorted(self._times, time))
        if after < len(self._times) and self._times[after] == time:
            return self._poses[after].copy()
        if after in (0, len(self._times)):
            return self._poses[min(after, len(self._times) - 1)].copy()
        begin, end = self._times[after - 1 : after + 1]
        return interpolate(self._poses[after - 1], self._poses[after], float((time - begin) / (end - begin)))
