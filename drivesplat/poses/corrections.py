"""Corrections of poses at the times of images, carried over to everything else that the own car's pose has placed."""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from drivesplat.rigid import inverse
from drivesplat.scene import Scene, Sweep, Track


@dataclass(frozen=True)
class Corrections:
    """At `timestamps` (n,), increasing, in microseconds: the given poses `ego_to_world` (n, 4, 4), and `corrections`
    (n, 4, 4) in the own car's frame: refined = given @ correction. In between, and beyond the ends as at the ends,
    translation and rotation vector are linear in time: corrections are small and change slowly."""

    timestamps: np.ndarray
    ego_to_world: np.ndarray
    corrections: np.ndarray

    @classmethod
    def between(cls, timestamps: np.ndarray, given: np.ndarray, refined: np.ndarray) -> "Corrections":
        """From given to refined ego_to_world (m, 4, 4) at `timestamps` (m,), of which some may be equal."""
        times, first = np.unique(timestamps, return_index=True)
        return cls(times, given[first], inverse(given[first]) @ refined[first])

    def at(self, timestamps: np.ndarray) -> np.ndarray:
        """The corrections (m, 4, 4) at `timestamps` (m,)."""
        vectors = np.concatenate([self.corrections[:, :3, 3], self._turns], axis=1)
        at = np.stack([np.interp(timestamps, self.timestamps, column) for column in vectors.T], axis=-1)
        transforms = np.tile(np.eye(4), (len(at), 1, 1))
        transforms[:, :3, 3] = at[:, :3]
        transforms[:, :3, :3] = Rotation.from_rotvec(at[:, 3:]).as_matrix()
        return transforms

    def in_world(self, timestamps: np.ndarray) -> np.ndarray:
        """The same as transforms of the world (m, 4, 4): what the car placed moves along with the car."""
        given = self._given(timestamps)
        return given @ self.at(timestamps) @ inverse(given)

    @cached_property
    def _turns(self) -> np.ndarray:
        return Rotation.from_matrix(self.corrections[:, :3, :3]).as_rotvec()

    def _given(self, timestamps: np.ndarray) -> np.ndarray:
        """The given poses (m, 4, 4) between the images; beyond the ends those at the ends."""
        within = np.clip(timestamps, self.timestamps[0], self.timestamps[-1])
        poses = np.tile(np.eye(4), (len(within), 1, 1))
        poses[:, :3, 3] = np.stack(
            [np.interp(within, self.timestamps, column) for column in self.ego_to_world[:, :3, 3].T], axis=-1
        )
        rotations = Rotation.from_matrix(self.ego_to_world[:, :3, :3])
        if len(self.timestamps) > 1:
            rotations = Slerp(self.timestamps.astype(np.float64), rotations)(within.astype(np.float64))
        poses[:, :3, :3] = rotations.as_matrix()
        return poses


def corrected(scene: Scene, corrections: Corrections) -> Scene:
    """The scene with its images, LiDAR sweeps and annotated boxes where the corrected own car puts them.

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
    return dataclasses.replace(scene, frames=frames, sweeps=sweeps, tracks=tracks, poses="refined")


def _moved_sweep(sweep: Sweep, corrections: Corrections) -> Sweep:
    moved = corrections.in_world(np.array([sweep.timestamp]))[0]
    return dataclasses.replace(sweep, sensor_to_world=moved @ sweep.sensor_to_world)


def _moved_track(track: Track, corrections: Corrections) -> Track:
    moved = corrections.in_world(track.timestamps)
    return dataclasses.replace(track, object_to_world=moved @ track.object_to_world)
