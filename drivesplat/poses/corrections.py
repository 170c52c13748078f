"""Corrections of poses at the times of images, carried over to everything else that the own car's pose has placed."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from drivesplat.scene.rigid import interpolate, inverse
from drivesplat.scene.scene import Scene, Sweep, Track


@dataclass(frozen=True)
class Corrections:
    """At `timestamps` (n,), increasing, in microseconds: the given poses `ego_to_world` (n, 4, 4), and `corrections`
    (n, 4, 4) in the own car's frame: refined = given @ correction. In between, and beyond the ends as at the ends,
    translations are linear in time, and rotations turn steadily about one axis: they may be large."""

    timestamps: np.ndarray
    ego_to_world: np.ndarray
    corrections: np.ndarray

    @classmethod
    def between(cls, timestamps: np.ndarray, given: np.ndarray, refined: np.ndarray) -> "Corrections":
        """From given to refined ego_to_world (m, 4, 4) at `timestamps` (m,), of which some may be equal."""
        times, first = np.unique(timestamps, return_index=True)
        return cls(times, given[first], inverse(given[first]) @ refined[first])

    def continued(self, microseconds: float) -> "Corrections":
        """The same for given poses that stand still: refined ones go on for so long beyond both ends, as fast as within
        as long a time before."""
        times, refined = self.timestamps, self.ego_to_world @ self.corrections
        if times[-1] - times[0] < microseconds:
            return self
        after_first = int(np.searchsorted(times, times[0] + microseconds))
        before_last = int(np.searchsorted(times, times[-1] - microseconds, side="right")) - 1
        share = microseconds / (times[[after_first, -1]] - times[[0, before_last]])
        start = interpolate(refined[0], refined[after_first], -share[0])
        end = interpolate(refined[before_last], refined[-1], 1.0 + share[1])
        beyond = np.array([times[0] - microseconds, *times, times[-1] + microseconds]).astype(np.int64)
        given = np.concatenate([self.ego_to_world[:1], self.ego_to_world, self.ego_to_world[-1:]])
        return Corrections.between(beyond, given, np.concatenate([start[None], refined, end[None]]))

    def at(self, timestamps: np.ndarray) -> np.ndarray:
        """The corrections (m, 4, 4) at `timestamps` (m,)."""
        return self._between(self.corrections, timestamps)

    def in_world(self, timestamps: np.ndarray) -> np.ndarray:
        """The same as transforms of the world (m, 4, 4): what the car placed moves along with the car."""
        given = self._between(self.ego_to_world, timestamps)
        return given @ self.at(timestamps) @ inverse(given)

    def _between(self, known: np.ndarray, timestamps: np.ndarray) -> np.ndarray:
        """What is `known` (n, 4, 4) at the images, at `timestamps` (m,): (m, 4, 4)."""
        within = np.clip(timestamps, self.timestamps[0], self.timestamps[-1])
        poses = np.tile(np.eye(4), (len(within), 1, 1))
        poses[:, :3, 3] = np.stack(
            [np.interp(within, self.timestamps, column) for column in known[:, :3, 3].T], axis=-1
        )
        rotations = Rotation.from_matrix(known[:, :3, :3])
        if len(self.timestamps) > 1:
            rotations = Slerp(self.timestamps.astype(np.float64), rotations)(within.astype(np.float64))
        poses[:, :3, :3] = rotations.as_matrix()
        return poses


def corrected(scene: Scene, corrections: Corrections, poses: str = "refined") -> Scene:
    """The scene with its images, LiDAR sweeps and annotated boxes where the corrected own car puts them; `poses` names
    where its poses come from.

    Boxes are annotated in LiDAR sweeps, so they move with the car's pose as the sweeps do.
    """
    deltas = corrections.at(np.array([frame.timestamp for frame in scene.frames]))
    frames = tuple(
        dataclasses.replace(
            frame,
            ego_to_world=frame.ego_to_world @ delta,
            camera_to_world=frame.ego_to_world @ delta @ inverse(frame.ego_to_world) @ frame.camera_to_world,
        )
        for frame, delta in zip(scene.frames, deltas, strict=True)
    )
    sweeps = tuple(_moved_sweep(sweep, corrections) for sweep in scene.sweeps)
    tracks = tuple(_moved_track(track, corrections) for track in scene.tracks)
    return dataclasses.replace(scene, frames=frames, sweeps=sweeps, tracks=tracks, poses=poses)


def _moved_sweep(sweep: Sweep, corrections: Corrections) -> Sweep:
    moved = corrections.in_world(np.array([sweep.timestamp]))[0]
    return dataclasses.replace(sweep, sensor_to_world=moved @ sweep.sensor_to_world)


def _moved_track(track: Track, corrections: Corrections) -> Track:
    moved = corrections.in_world(track.timestamps)
    return dataclasses.replace(track, object_to_world=moved @ track.object_to_world)
