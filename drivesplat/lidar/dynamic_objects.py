"""The moving objects of a drive, and their LiDAR returns."""

from dataclasses import dataclass

import numpy as np

from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import in_box, moving_tracks
from drivesplat.trajectories.motion import HALF_STEP, Motion

CLEARANCE = 0.1
"""Height in metres above a box's floor up to which a return may belong to the road."""


@dataclass(frozen=True)
class DynamicObject:
    """A track that moves at some time, and its motion."""

    track: Track
    motion: Motion

    def pose(self, seconds: float) -> np.ndarray | None:
        """Object to world (4, 4) at a time (seconds since the scene's first image); None if it is absent."""
        at = np.array([seconds])
        return self.motion.poses(at)[0] if self.motion.present(at)[0] else None

    def velocities(self, points: np.ndarray, seconds: float) -> np.ndarray:
        """The velocities (n, 3) in the world, m/s, of points (n, 3) in the object's frame at a time."""
        poses = self.motion.poses(seconds + HALF_STEP * np.array([-1.0, 1.0]))
        before, after = (apply(pose, points) for pose in poses)
        return (after - before) / (2.0 * HALF_STEP)

    def own(self, points: np.ndarray, seconds: float, margin: float) -> np.ndarray:
        """The points in its box at a time, of world points (n, 3): (m, 3) in the object's frame. The sides and the roof
        of the box are expanded by `margin` metres, its floor is raised by CLEARANCE."""
        pose = self.pose(seconds)
        if pose is None:
            return np.empty((0, 3))
        return apply(inverse(pose), points[in_box(points, pose, self.track.size, margin, CLEARANCE)])

    def near(self, points: np.ndarray, seconds: float, margin: float) -> np.ndarray:
        """Whether world points (n, 3) may belong to it at a time: (n,) bool. All sides of its box are expanded."""
        pose = self.pose(seconds)
        if pose is None:
            return np.zeros(len(points), dtype=bool)
        return in_box(points, pose, self.track.size, margin, -margin)


def dynamic_objects(scene: Scene) -> list[DynamicObject]:
    """All vehicles and people that move at any time in a scene, by the thresholds of `Box.moves`."""
    return [DynamicObject(track, Motion.of_track(scene, track)) for track in moving_tracks(scene)]
