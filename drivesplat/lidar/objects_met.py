"""The objects that LiDAR returns lie in, each at its own time."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from drivesplat.scene.rigid import inverse
from drivesplat.scene.scan_record import NO_OBJECT
from drivesplat.scene.scene import Scene
from drivesplat.trajectories.motion import Motion

SLACK = 1.0
"""Metres around a box's way within which returns are looked at."""


@dataclass(frozen=True)
class TrackedBoxes:
    """The boxes of the tracks of dynamic classes: `indices` are those of `Scene.tracks`."""

    indices: list[int]
    sizes: list[Float[np.ndarray, "3"]]
    motions: list[Motion]

    @classmethod
    def of_scene(cls, scene: Scene, without: Collection[str] = ()) -> "TrackedBoxes":
        """The boxes of a scene, but those of the tracks `without`."""
        wanted = (track.object_class.is_dynamic and track.id not in without for track in scene.tracks)
        chosen = [i for i, is_wanted in enumerate(wanted) if is_wanted]
        tracks = [scene.tracks[i] for i in chosen]
        return cls(chosen, [track.size for track in tracks], [Motion.of_track(scene, track) for track in tracks])

    def met(
        self, points: Float[np.ndarray, "n 3"], origins: Float[np.ndarray, "n 3"], seconds: Float[np.ndarray, " n"]
    ) -> Int[np.ndarray, " n"]:
        """The indices of the tracks in whose boxes world points lie at their own times, or NO_OBJECT.

        `origins` are the sensor's positions, `seconds` count from the scene's first image. Of several boxes the one is
        taken whose centre is nearest to the sensor.
        """
        found = np.full(len(points), NO_OBJECT, dtype=np.int16)
        nearest = np.full(len(points), np.inf)
        if not len(points):
            return found
        ends = np.array([seconds.min(), seconds.max()])
        for index, size, motion in zip(self.indices, self.sizes, self.motions, strict=True):
            first, last = motion.poses(ends)[:, :3, 3]
            reach = 0.5 * np.linalg.norm(size) + 0.5 * np.linalg.norm(last - first) + SLACK
            near = np.flatnonzero(np.linalg.norm(points - 0.5 * (first + last), axis=1) < reach)
            near = near[motion.present(seconds[near])] if len(near) else near
            if not len(near):
                continue
            times, own = np.unique(seconds[near], return_inverse=True)
            poses = motion.poses(times)
            local = np.einsum("nij,nj->ni", inverse(poses)[own, :3], np.insert(points[near], 3, 1.0, axis=1))
            distance = np.linalg.norm(poses[own, :3, 3] - origins[near], axis=1)
            inside = (np.abs(local) <= 0.5 * size).all(axis=1) & (distance < nearest[near])
            found[near[inside]], nearest[near[inside]] = index, distance[inside]
        return found
