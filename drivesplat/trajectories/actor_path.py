"""The path of an actor in an edited drive: its trajectory, its position along it over time, and its offsets from it.

`times` (n,) are seconds of the film. `edited_actors` creates paths, `drivesplat.trajectories.steps` changes them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.trajectories.lateral_offset import offset_poses, rotate_yaw
from drivesplat.trajectories.motion import Motion
from drivesplat.trajectories.object_trajectory import ObjectTrajectory


@dataclass(frozen=True)
class PathPosition:
    """A position along a trajectory: that at the recorded seconds `clock` (n,), plus `advance` (n,) metres.

    `deviation_weight` (n,) in [0, 1] weighs the deviation of the recording from the path by distance; 0 at a speed
    independent of the recorded one.
    """

    clock: np.ndarray
    advance: np.ndarray
    deviation_weight: np.ndarray


@dataclass(frozen=True)
class PathOffsets:
    """Offsets from a path, each (n,): `longitudinal` metres forward along it, `lateral` metres to its left,
    `lateral_speed` in m/s, `yaw` in radians to the left."""

    longitudinal: np.ndarray
    lateral: np.ndarray
    lateral_speed: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True)
class ActorPath:
    """A path along `trajectory`, whose box centres were recorded half of `height` (metres) above the ground.

    `position`, `offsets` and `recorded` (presence in the recording, (n,) bool) are functions of film seconds (n,).
    `begin` and `end` are the first and last second as recorded, `paced_from` the second from which the pace is edited.
    `direction` is 1 as recorded, -1 backwards; `facing` is 1 as recorded, -1 turned round.
    """

    trajectory: ObjectTrajectory
    height: float
    position: Callable[[np.ndarray], PathPosition]
    offsets: Callable[[np.ndarray], PathOffsets]
    recorded: Callable[[np.ndarray], np.ndarray]
    begin: float
    end: float
    paced_from: float = np.inf
    direction: int = 1
    facing: int = 1

    def distance(self, times: np.ndarray) -> np.ndarray:
        """The distance (n,) in metres along the trajectory, without offsets."""
        position = self.position(times)
        return self.trajectory.distance(position.clock) + position.advance

    def walked(self, times: np.ndarray) -> np.ndarray:
        """The distance (n,) in metres by which the limbs of the actor have advanced: backwards where it moves against
        the direction that it faces."""
        return self.facing * self.distance(times)

    def present(self, times: np.ndarray) -> np.ndarray:
        """Whether the actor is present (n,): while it was recorded and, once its pace is edited, also while its
        distance without offsets is within the recorded range."""
        present, paced = self.recorded(times), times >= self.paced_from
        if paced.any():
            low, high = self.trajectory.recorded_range
            distances = self.distance(times[paced])
            present[paced] |= (low <= distances) & (distances <= high)
        return present

    def poses(self, times: np.ndarray, height: float) -> np.ndarray:
        """The centre poses (n, 4, 4) of a box `height` metres high that stands on the ground of this path."""
        offsets = self.offsets(times)
        poses = offset_poses(self._poses_on_path, times, offsets.lateral, offsets.lateral_speed)
        poses[:, :3, 3] += 0.5 * (height - self.height) * poses[:, :3, 2]
        return rotate_yaw(poses, offsets.yaw)

    def _poses_on_path(self, times: np.ndarray) -> np.ndarray:
        """The poses (n, 4, 4) without lateral offset and yaw."""
        position, longitudinal = self.position(times), self.offsets(times).longitudinal
        distances = self.trajectory.distance(position.clock) + position.advance + longitudinal
        deviation, weight = self.trajectory.deviation(position.clock), position.deviation_weight[:, None]
        turns = Rotation.from_matrix(deviation[:, :3, :3]).as_rotvec()
        deviation[:, :3, :3] = Rotation.from_rotvec(weight * turns).as_matrix()
        deviation[:, :3, 3] *= weight
        return self.trajectory.poses_at_distance(distances) @ deviation


def recorded_path(motion: Motion, height: float) -> ActorPath:
    """The recorded path of an object `height` metres high."""
    begin, end = motion.span
    return ActorPath(
        trajectory=ObjectTrajectory(motion),
        height=height,
        position=lambda times: PathPosition(times, np.zeros(len(times)), np.ones(len(times))),
        offsets=lambda times: PathOffsets(*np.zeros((4, len(times)))),
        recorded=motion.present,
        begin=begin,
        end=end,
    )
