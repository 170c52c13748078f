"""Poses of drive folders as matrices, and the ego vehicle's path."""

import numpy as np

from drivesplat.readers.checks import checked_pose, checked_transform
from drivesplat.readers.drive.format import Drive, Pose
from drivesplat.scene.rigid import interpolate


def matrix_of(pose: Pose, record: str = "pose") -> np.ndarray:
    """A pose as a transform (4, 4). Raises DatasetError naming `record` if it is not rigid."""
    if len(pose.rotation) == 4:
        return checked_pose(pose.translation, pose.rotation, record)
    rows = [[*row, place] for row, place in zip(pose.rotation, pose.translation, strict=True)]
    return checked_transform([*rows, [0.0, 0.0, 0.0, 1.0]], record)


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
