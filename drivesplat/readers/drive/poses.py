"""Poses of drive folders as matrices, and the ego vehicle's path."""

import numpy as np

from drivesplat.readers.checks import MAX_COORDINATE, checked_pose, checked_transform
from drivesplat.readers.drive.format import Drive, Pose
from drivesplat.scene.rigid import interpolate, inverse
from drivesplat.scene.sensors import SweepMotion

MAX_POSE_GAP = 1_000_000
"""Microseconds between ego poses over which poses of images and sweeps are interpolated."""
KNOT_US = 5_000
"""Least interval in microseconds between poses of a sweep's motion; over it an acceleration of 1 g moves 0.03 mm."""
REVOLUTION_US = 200_000
"""Time of a LiDAR's revolution in microseconds, where it is unknown: the slowest turn five times a second."""
CONTINUED_US = 60_000
"""Maximum time in microseconds over which motion is continued beyond ego poses: half of a usual revolution. An
acceleration of 3 m/s² then moves 5 mm, and 14 mm with poses at 10 Hz."""


def matrix_of(pose: Pose, record: str = "pose", bound: float = MAX_COORDINATE) -> np.ndarray:
    """A pose as a transform (4, 4). Raises DatasetError naming `record` if it is not rigid, or its translation beyond
    `bound` metres along an axis."""
    if len(pose.rotation) == 4:
        return checked_pose(pose.translation, pose.rotation, record, bound)
    rows = [[*row, place] for row, place in zip(pose.rotation, pose.translation, strict=True)]
    return checked_transform([*rows, [0.0, 0.0, 0.0, 1.0]], record, bound)


class EgoPath:
    """The ego vehicle's path in the drive's world."""

    def __init__(self, drive: Drive):
        self._times = np.array([pose.timestamp for pose in drive.ego_poses], dtype=np.int64)
        self._poses = [matrix_of(pose) for pose in drive.ego_poses]

    def __len__(self) -> int:
        return len(self._times)

    def at(self, time: int) -> np.ndarray:
        """Ego to world (4, 4) at a time: the given pose, or linear position and slerp between two. Outside the given
        times, which faults exclude for all recordings, the nearest pose; the identity in a drive without poses."""
        if not len(self._times):
            return np.eye(4)
        after = int(np.searchsorted(self._times, time))
        if after < len(self._times) and self._times[after] == time:
            return self._poses[after].copy()
        if after in (0, len(self._times)):
            return self._poses[min(after, len(self._times) - 1)].copy()
        begin, end = self._times[after - 1 : after + 1]
        return interpolate(self._poses[after - 1], self._poses[after], float((time - begin) / (end - begin)))

    def motion(self, time: int, sensor_to_ego: np.ndarray, revolution_s: float | None) -> SweepMotion:
        """The motion during a sweep at `time`, a revolution before and after it, as far as there are ego poses at most
        MAX_POSE_GAP apart, and beyond their ends for CONTINUED_US, at most half a revolution or the interval of poses.
        `sensor_to_ego` (4, 4) is the LiDAR's mount. Without ego poses the vehicle stands."""
        reach = reach_us(revolution_s)
        to_sweep = inverse(self.at(time) @ sensor_to_ego)
        if not len(self._times):
            return SweepMotion(np.array([-reach, reach]) * 1e-6, np.stack([to_sweep, to_sweep]), sensor_to_ego)
        gaps = np.flatnonzero(np.diff(self._times) > MAX_POSE_GAP)
        first = max([0, *(gaps + 1)[self._times[gaps + 1] <= time]])
        last = min([len(self._times) - 1, *gaps[self._times[gaps] >= time]])
        before, after = (
            min(CONTINUED_US, reach // 2, int(np.diff(self._times[pair])[0])) if last > first else 0
            for pair in ([first, first + 1], [last - 1, last])
        )
        begin, end = max(time - reach, self._times[first] - before), min(time + reach, self._times[last] + after)
        within = self._times[(self._times > begin) & (self._times < end)]
        within = within[np.unique(within // KNOT_US, return_index=True)[1]]
        knots = np.unique([begin, *within, end])
        poses = np.stack([to_sweep @ self._continued(int(knot), int(first), int(last)) for knot in knots])
        return SweepMotion((knots - time) * 1e-6, poses, sensor_to_ego)

    def _continued(self, time: int, first: int, last: int) -> np.ndarray:
        """Ego to world (4, 4) at a time; before the pose `first` and after `last` the motion next to it continues."""
        if self._times[first] <= time <= self._times[last]:
            return self.at(time)
        i = first if time < self._times[first] else last - 1
        begin, end = self._times[i : i + 2]
        return interpolate(self._poses[i], self._poses[i + 1], float((time - begin) / (end - begin)))


def reach_us(revolution_s: float | None) -> int:
    """The time in microseconds before and after a sweep's timestamp over which its motion is read."""
    return REVOLUTION_US if revolution_s is None else round(revolution_s * 1e6)
