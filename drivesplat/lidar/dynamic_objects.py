"""What moves in a drive, and which LiDAR returns are its own."""

from dataclasses import dataclass

import numpy as np

from drivesplat.scene.motion import Motion
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import in_box, moving_tracks

CLEARANCE = 0.1
"""What lies lower over a box's floor than this (metres) may be road as well as wheel."""


@dataclass(frozen=True)
class DynamicObject:
    """A track that moves, and its motion."""

    track: Track
    motion: Motion

    def pose(self, seconds: float) -> np.ndarray | None:
        """Object to world (4, 4) at a time (seconds since the scene's first image); None where it is absent."""
        at = np.array([seconds])
        return self.motion.poses(at)[0] if self.motion.present(at)[0] else None

    def own(self, points: np.ndarray, seconds: float, margin: float) -> np.ndarray:
        """Those of the world points (n, 3) found at a time that lie in its box, grown by `margin` metres at its sides
        and roof and raised by CLEARANCE: (m, 3) in the object's frame."""
        pose = self.pose(seconds)
        if pose is None:
            return np.empty((0, 3))
        return apply(inverse(pose), points[in_box(points, pose, self.track.size, margin, CLEARANCE)])

    def near(self, points: np.ndarray, seconds: float, margin: float) -> np.ndarray:
        """Which of the world points (n, 3) found at a time may be its own: (n,) bool. The box's floor is grown, too."""
        pose = self.pose(seconds)
        if pose is None:
            return np.zeros(len(points), dtype=bool)
        return in_box(points, pose, self.track.size, margin, -margin)


def dynamic_objects(scene: Scene) -> list[DynamicObject]:
    """Every vehicle and person that ever moves in a scene, by the measuring protocol's thresholds."""
    return [DynamicObject(track, Motion.of_track(scene, track)) for track in moving_tracks(scene)]
