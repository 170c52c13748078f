"""Poses of requests: of sensors and objects, at the start and the end of a frame."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from drivesplat.lidar.moved_sensor import steady_motion
from drivesplat.model.states import ActorPlacement
from drivesplat.scene.rigid import rigid
from drivesplat.serve.faults import invalid
from drivesplat.serve.messages import wire
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.motion import HALF_STEP

MAX_DISTANCE = 1e6
"""Metres from the origin of the scene. In the single precision of messages, poses farther away are useless."""
MIN_NORM = 1e-3
"""Norm of a quaternion below which it is no rotation."""
MAX_FRAME_US = 10_000_000
"""Longest frame in microseconds."""


@dataclass(frozen=True)
class FrameTimes:
    """When a frame starts and ends, in microseconds of the recording. With `at_start`, as a global shutter, it shows
    the world at its start, otherwise at its middle."""

    start_us: int
    end_us: int
    at_start: bool

    @classmethod
    def checked(cls, start_us: int, end_us: int, at_start: bool) -> "FrameTimes":
        """Raises ServiceError for a frame that ends before it starts or is longer than MAX_FRAME_US."""
        if not 0 <= end_us - start_us <= MAX_FRAME_US:
            raise invalid(
                f"a frame from frame_start_us {start_us} to frame_end_us {end_us} lasts {end_us - start_us} us; it "
                f"must last 0 to {MAX_FRAME_US}"
            )
        return cls(start_us, end_us, at_start)

    @property
    def length_s(self) -> float:
        """In seconds."""
        return (self.end_us - self.start_us) * 1e-6

    @property
    def shown_us(self) -> tuple[int, int]:
        """The moment that is shown, in microseconds, and whether half a microsecond more (1) or not (0)."""
        return divmod(2 * self.start_us if self.at_start else self.start_us + self.end_us, 2)


@dataclass(frozen=True, eq=False)
class SteadyPoses:
    """Poses (n, 4, 4) at the time of a frame, and velocities (n, 6) during it: linear (m/s), then angular (rad/s),
    along the axes of the pose."""

    poses: Float64[np.ndarray, "n 4 4"]
    velocities: Float64[np.ndarray, "n 6"]

    def seen_from(self, origin: Float64[np.ndarray, "3"]) -> "SteadyPoses":
        """The same in a world with its origin at a place of this one, in metres."""
        return SteadyPoses(rigid(self.poses[:, :3, :3], self.poses[:, :3, 3] - origin), self.velocities)


def steady_poses(pairs: Sequence[Any], names: Sequence[str], times: FrameTimes) -> SteadyPoses:
    """Motions from the first pose of each `PosePair` to the second during a frame: positions are linear in time,
    rotations a slerp. A frame without length has no velocities.

    Raises ServiceError that names, of `names`, the first whose poses are missing or malformed.
    """
    values = np.array([_numbers(pair) for pair in pairs], dtype=np.float64).reshape(-1, 2, 7)
    norms = np.linalg.norm(values[..., 3:], axis=-1)
    _require_poses(names, values, norms)
    positions, quaternions = values[..., :3], values[..., 3:] / norms[..., None]
    if not len(values):
        return SteadyPoses(np.zeros((0, 4, 4)), np.zeros((0, 6)))
    first, last = (Rotation.from_quat(quaternions[:, i], scalar_first=True) for i in (0, 1))
    turns, fraction = (first.inv() * last).as_rotvec(), 0.0 if times.at_start else 0.5
    rotations = (first * Rotation.from_rotvec(fraction * turns)).as_matrix()
    poses = rigid(rotations, (1.0 - fraction) * positions[:, 0] + fraction * positions[:, 1])
    moving = np.einsum("nji,nj->ni", rotations, positions[:, 1] - positions[:, 0])  # a rotation keeps its own axis
    rate = 1.0 / times.length_s if times.length_s else 0.0
    return SteadyPoses(poses, rate * np.hstack([moving, turns]))


def _numbers(pair: Any) -> list[float]:
    """Both poses of a pair: x, y, z and the quaternion w, x, y, z of each."""
    found: list[float] = []
    for pose in (pair.start_pose, pair.end_pose):
        vec, quat = pose.vec, pose.quat
        found += (vec.x, vec.y, vec.z, quat.w, quat.x, quat.y, quat.z)
    return found


def _require_poses(
    names: Sequence[str], values: Float64[np.ndarray, "n 2 7"], norms: Float64[np.ndarray, "n 2"]
) -> None:
    finite, turned = np.isfinite(values).all(axis=-1), norms >= MIN_NORM
    near = np.abs(values[..., :3]).max(axis=-1) <= MAX_DISTANCE
    wrong = np.argwhere(~(finite & turned & near)).tolist()
    if not wrong:
        return
    first, end = wrong[0]
    where = f"{names[first]}: its {('start_pose', 'end_pose')[end]}"
    if not finite[first, end]:
        raise invalid(f"{where} has numbers that are not finite")
    if not turned[first, end]:
        raise invalid(f"{where} is missing or has a quaternion of zeros, which is no rotation")
    raise invalid(f"{where} is more than {MAX_DISTANCE:g} m from the origin of the scene")


@dataclass(frozen=True, eq=False)
class ListedObjects:
    """The dynamic objects that a request lists, by the ids of their tracks: where the centres of their boxes are
    during a frame."""

    ids: tuple[str, ...]
    steady: SteadyPoses

    @classmethod
    def of(cls, messages: Sequence[Any], times: FrameTimes) -> "ListedObjects":
        """Raises ServiceError for malformed poses and for a track that is listed twice."""
        ids = tuple(message.track_id for message in messages)
        if len(set(ids)) < len(ids):
            twice = next(name for name, count in Counter(ids).items() if count > 1)
            raise invalid(f"dynamic_objects lists track {twice[:80]!r} twice")
        names = [f"the dynamic object {name[:80]!r}" for name in ids]
        return cls(ids, steady_poses([message.pose_pair for message in messages], names, times))

    def placements(self, actors: Mapping[str, EditedActor]) -> dict[str, ActorPlacement]:
        """The places of those of the `actors` that are listed."""
        found = {}
        for name, pose, velocity in zip(self.ids, self.steady.poses, self.steady.velocities, strict=True):
            if name in actors:
                before, after = steady_motion(pose, velocity[:3], velocity[3:])(np.array([-HALF_STEP, HALF_STEP]))
                found[name] = ActorPlacement(actors[name].source, pose, around=(before, after))
        return found


def pose_message(pose: Float64[np.ndarray, "4 4"]) -> Any:
    """A pose (4, 4) as a message."""
    w, x, y, z = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True).tolist()
    px, py, pz = pose[:3, 3].tolist()
    return wire.Pose(vec=wire.Vec3(x=px, y=py, z=pz), quat=wire.Quat(w=w, x=x, y=y, z=z))
