"""Pose corrections at the times of images, applied to everything that the ego pose has placed."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.scene.pose_path import PosePath
from drivesplat.scene.rigid import interpolate, inverse
from drivesplat.scene.scene import UNPOSED, Scene


@dataclass(frozen=True)
class Corrections:
    """At `timestamps` (n,), increasing, in microseconds: the given poses `ego_to_world` (n, 4, 4), and `corrections`
    (n, 4, 4) in the ego frame: refined = given @ correction. Interpolation is linear in translation and spherical in
    rotation, which may be large; it is constant beyond the ends."""

    timestamps: np.ndarray
    ego_to_world: np.ndarray
    corrections: np.ndarray

    @classmethod
    def from_poses(cls, timestamps: np.ndarray, given: np.ndarray, refined: np.ndarray) -> "Corrections":
        """From given to refined ego_to_world (m, 4, 4) at `timestamps` (m,). Of equal timestamps the first counts."""
        times, first = np.unique(timestamps, return_index=True)
        return cls(times, given[first], inverse(given[first]) @ refined[first])

    def extrapolated(self, microseconds: float) -> "Corrections":
        """For given poses that do not move: refined motion continues for `microseconds` beyond both ends, at the mean
        velocity of the outermost `microseconds` within. Unchanged where the drive is shorter."""
        times, refined = self.timestamps, self.ego_to_world @ self.corrections
        if times[-1] - times[0] < microseconds:
            return self
        after_first = int(np.searchsorted(times, times[0] + microseconds))
        before_last = int(np.searchsorted(times, times[-1] - microseconds, side="right")) - 1
        fraction = microseconds / (times[[after_first, -1]] - times[[0, before_last]])
        start = interpolate(refined[0], refined[after_first], -fraction[0])
        end = interpolate(refined[before_last], refined[-1], 1.0 + fraction[1])
        extended = np.array([times[0] - microseconds, *times, times[-1] + microseconds]).astype(np.int64)
        given = self.ego_to_world[[0, *range(len(times)), -1]]
        return Corrections.from_poses(extended, given, np.concatenate([start[None], refined, end[None]]))

    def at(self, timestamps: np.ndarray) -> np.ndarray:
        """The corrections (m, 4, 4) at `timestamps` (m,)."""
        return self._interpolated(self.corrections, timestamps)

    def in_world(self, timestamps: np.ndarray) -> np.ndarray:
        """The corrections as transforms of the world frame (m, 4, 4), for everything placed by the ego pose."""
        given = self._interpolated(self.ego_to_world, timestamps)
        return given @ self.at(timestamps) @ inverse(given)

    def _interpolated(self, transforms: np.ndarray, timestamps: np.ndarray) -> np.ndarray:
        """`transforms` (n, 4, 4), one per image, interpolated at `timestamps` (m,): (m, 4, 4)."""
        return PosePath(self.timestamps, transforms).at(timestamps)


def magnitudes(corrections: np.ndarray) -> dict[str, dict[str, float]]:
    """`shift_m` and `turn_deg` of corrections (n, 4, 4): their median and largest translation and rotation."""
    shift = np.linalg.norm(corrections[:, :3, 3], axis=1)
    turn = np.degrees(Rotation.from_matrix(corrections[:, :3, :3]).magnitude())
    return {
        name: {"median": float(np.median(values)), "largest": float(values.max())}
        for name, values in (("shift_m", shift), ("turn_deg", turn))
    }


def apply_corrections(scene: Scene, corrections: Corrections, poses: str = "refined") -> Scene:
    """The scene with corrected poses of images, LiDAR sweeps and boxes; `poses` becomes `Scene.poses`.

    Boxes are annotated in LiDAR sweeps, so they move as the sweeps do. Sweeps that are not motion-compensated keep the
    recorded motion; in a scene without poses, whose vehicle stands, they get the corrected one.
    """
    deltas = corrections.at(np.array([frame.timestamp for frame in scene.frames]))
    frames = tuple(
        replace(
            frame,
            ego_to_world=frame.ego_to_world @ delta,
            camera_to_world=frame.ego_to_world @ delta @ inverse(frame.ego_to_world) @ frame.camera_to_world,
        )
        for frame, delta in zip(scene.frames, deltas, strict=True)
    )
    sweeps = []
    for sweep in scene.sweeps:
        placed = corrections.in_world(np.array([sweep.timestamp]))[0] @ sweep.sensor_to_world
        motion = sweep.motion
        if motion is not None and scene.poses == UNPOSED:
            begin, end = sweep.timestamp + np.round(motion.offsets_s[[0, -1]] * 1e6).astype(np.int64)
            within = corrections.timestamps[(corrections.timestamps > begin) & (corrections.timestamps < end)]
            times = np.unique([begin, *within, end])
            ego_to_world = sweep.sensor_to_world @ motion.ego_to_sweep[0] @ corrections.at(times)
            offsets_s = (times - sweep.timestamp) * 1e-6
            motion = replace(motion, offsets_s=offsets_s, ego_to_sweep=inverse(placed) @ ego_to_world)
        sweeps.append(replace(sweep, sensor_to_world=placed, motion=motion))
    tracks = tuple(
        replace(track, object_to_world=corrections.in_world(track.timestamps) @ track.object_to_world)
        for track in scene.tracks
    )
    return replace(scene, frames=frames, sweeps=tuple(sweeps), tracks=tracks, poses=poses)
