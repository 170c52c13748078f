"""The transforms of a bag: poses of frames in each other over time, and the path of the ego vehicle."""

from array import array
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.bag.bag_file import BagFile, BagMessage, frame_name, header_stamp, listed, microseconds
from drivesplat.readers.drive.poses import KNOT_US, MAX_POSE_GAP
from drivesplat.scene.pose_path import PosePath
from drivesplat.scene.rigid import interpolate, inverse, rigid

TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
ODOMETRY = "nav_msgs/msg/Odometry"
LATCHED = "tf_static"
"""The end of the name of topics whose transforms hold at all times."""
MAX_EXTRAPOLATED_US = 100_000
"""Microseconds beyond the first and the last pose up to which the motion is continued."""
UNIT_TOLERANCE = 1e-2
"""By which the length of a quaternion may differ from 1."""
CONSTANT = 1e-9
"""Metres, and entries of a quaternion, by which a constant transform may vary."""


@dataclass(frozen=True, eq=False)
class FrameEdge:
    """The frame `child` in the frame `parent` at increasing `stamps` (microseconds): places in metres and unit
    quaternions x, y, z, w. `latched`: at all times."""

    parent: str
    child: str
    stamps: Int64[np.ndarray, " n"]
    places: Float64[np.ndarray, "n 3"]
    turns: Float64[np.ndarray, "n 4"]
    latched: bool

    @cached_property
    def constant(self) -> bool:
        """Whether the transform never changes. One that was recorded once may have changed."""
        if self.latched:
            return True
        same = np.abs(self.turns @ self.turns[0]) > 1.0 - CONSTANT
        return len(self.stamps) > 1 and bool(same.all() and (np.ptp(self.places, axis=0) < CONSTANT).all())

    @cached_property
    def _path(self) -> PosePath:
        return PosePath(self.stamps, rigid(Rotation.from_quat(self.turns).as_matrix(), self.places))

    def poses(self, stamps: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "m 4 4"]:
        """The poses at times: linear position and slerp, outside the recorded times the nearest."""
        return self._path.at(stamps)


class TransformTree:
    """Frames that are connected by transforms. `damaged`: what was left out, such as "base_link to map", and how
    often."""

    def __init__(self, edges: Iterable[FrameEdge], damaged: Mapping[str, int] | None = None):
        self.edges, self.damaged = list(edges), dict(damaged or {})
        self._beside: dict[str, list[tuple[str, FrameEdge]]] = defaultdict(list)
        for edge in self.edges:
            self._beside[edge.child].append((edge.parent, edge))
            self._beside[edge.parent].append((edge.child, edge))

    @property
    def frames(self) -> list[str]:
        return sorted(self._beside)

    def route(self, source: str, target: str) -> list[tuple[FrameEdge, bool]] | None:
        """The transforms from `source` to `target`, each with whether it leads to its parent; None if there is no
        connection."""
        found: dict[str, list[tuple[FrameEdge, bool]]] = {source: []}
        queue = deque([source])
        while queue and target not in found:
            name = queue.popleft()
            for other, edge in self._beside.get(name, ()):
                if other not in found:
                    found[other] = [*found[name], (edge, other == edge.parent)]
                    queue.append(other)
        return found.get(target)

    def require(self, source: str, target: str) -> list[tuple[FrameEdge, bool]]:
        """`route`, or DatasetError."""
        route = self.route(source, target)
        if route is None:
            raise DatasetError(
                f"tf does not connect {source} with {target}; its frames are {listed(self.frames)}: name others in "
                "the map, or state the mount of a sensor there"
            )
        return route

    def poses(self, source: str, target: str, stamps: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "m 4 4"]:
        """The poses of `source` in `target` at times. Raises DatasetError where they are not connected."""
        pose = np.tile(np.eye(4), (len(stamps), 1, 1))
        for edge, to_parent in self.require(source, target):
            pose = (edge.poses(stamps) if to_parent else inverse(edge.poses(stamps))) @ pose
        return pose


class TransformTable:
    """Transforms as they are read: 64 bytes for each."""

    def __init__(self) -> None:
        self._rows: dict[tuple[str, str, bool], array] = defaultdict(lambda: array("d"))
        self._stamps: dict[tuple[str, str, bool], array] = defaultdict(lambda: array("q"))
        self.damaged: Counter[str] = Counter()

    def add(self, header: Any, child: Any, stamp: int, place: Any, turn: Any, latched: bool = False) -> None:
        """Adds the pose of the frame `child` in that of `header`: messages with x, y, z and x, y, z, w."""
        key = frame_name(header.frame_id), frame_name(child), latched
        self._rows[key].extend((place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))
        self._stamps[key].append(stamp)

    def contents(self, messages: Iterable[BagMessage]) -> Iterator[tuple[BagMessage, Any]]:
        """Messages with their contents; damaged ones are counted."""
        for message in messages:
            try:
                content = message.content()
            except DatasetError:
                self.damaged[f"messages on {message.topic}"] += 1
                continue
            yield message, content

    def tree(self) -> TransformTree:
        """The transforms in the order of time, of equal times the last, without those that are not rigid. Latched ones
        hold their last value; they count more than the same transform on other topics."""
        edges: dict[tuple[str, str], FrameEdge] = {}
        for (parent, child, latched), rows in sorted(self._rows.items(), key=lambda item: item[0][2]):
            values = np.frombuffer(rows, dtype=np.float64).reshape(-1, 7)
            stamps = np.frombuffer(self._stamps[parent, child, latched], dtype=np.int64)
            with np.errstate(over="ignore", invalid="ignore"):
                lengths = np.linalg.norm(values[:, 3:], axis=1)
                sound = np.isfinite(values).all(axis=1) & (np.abs(lengths - 1.0) < UNIT_TOLERANCE) & (parent != child)
            if not sound.all():
                self.damaged[f"transforms of {child} to {parent}"] += int((~sound).sum())
            values, stamps = values[sound][-1 if latched else 0 :], stamps[sound][-1 if latched else 0 :]
            if not len(stamps):
                continue
            stamps, last = np.unique(stamps[::-1], return_index=True)
            values = values[::-1][last]
            turns = values[:, 3:] / np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
            edges[parent, child] = FrameEdge(parent, child, stamps, values[:, :3], turns, latched)
        return TransformTree(edges.values(), self.damaged)


def read_transforms(
    bag: BagFile, clock: str, odometry: str | None, vehicle: str | None, begin: int, end: int
) -> TransformTree:
    """The transforms on all tf topics with log times from `begin` to `end` (nanoseconds), latched ones of all times,
    and the poses of a topic of Odometry. These replace what tf says of `vehicle` over time."""

    def time(stamped: Any, message: BagMessage) -> int:
        return microseconds(header_stamp(stamped) if clock == "header" else message.log)

    table, topics = TransformTable(), [topic.name for topic in bag.of_kind(*TRANSFORMS)]
    latched = [name for name in topics if name.endswith(LATCHED)]
    for _, content in table.contents(bag.messages(latched)):
        for one in content.transforms:
            place, turn = one.transform.translation, one.transform.rotation
            table.add(one.header, one.child_frame_id, 0, place, turn, latched=True)
    moving = [name for name in topics if name not in latched]
    for message, content in table.contents(bag.messages(moving, begin, end)):
        for one in content.transforms:
            if odometry is None or frame_name(one.child_frame_id) != vehicle:
                place, turn = one.transform.translation, one.transform.rotation
                table.add(one.header, one.child_frame_id, time(one, message), place, turn)
    for message, one in table.contents(bag.messages([odometry] if odometry else [], begin, end)):
        pose = one.pose.pose
        table.add(one.header, one.child_frame_id or vehicle, time(one, message), pose.position, pose.orientation)
    return table.tree()


@dataclass(frozen=True, eq=False)
class EgoTrack:
    """The ego vehicle in the world at increasing `stamps` (microseconds)."""

    stamps: Int64[np.ndarray, " n"]
    poses: Float64[np.ndarray, "n 4 4"]

    def at(self, stamps: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "m 4 4"]:
        """The poses at times within those of the track: linear position and slerp."""
        return PosePath(self.stamps, self.poses).at(stamps)

    def covers(self, stamp: int) -> bool:
        """Whether there is a pose at a time: between two that are at most MAX_POSE_GAP apart, or at most
        MAX_EXTRAPOLATED_US beyond the first or the last."""
        after = int(np.searchsorted(self.stamps, stamp))
        if after < len(self.stamps) and self.stamps[after] == stamp:
            return True
        if after == 0:
            return bool(self.stamps[0] - stamp <= MAX_EXTRAPOLATED_US)
        if after == len(self.stamps):
            return bool(stamp - self.stamps[-1] <= MAX_EXTRAPOLATED_US)
        return bool(self.stamps[after] - self.stamps[after - 1] <= MAX_POSE_GAP)

    def reaching(self, first: int, last: int) -> "EgoTrack":
        """The track with a pose more at `first` and at `last` where these are beyond its ends: the mean motion of the
        nearest tenth of a second goes on."""
        begin = min(np.searchsorted(self.stamps, self.stamps[0] + MAX_EXTRAPOLATED_US), len(self.stamps) - 1)
        end = max(np.searchsorted(self.stamps, self.stamps[-1] - MAX_EXTRAPOLATED_US, "right") - 1, 0)
        stamps, poses = list(self.stamps), list(self.poses)
        if first < self.stamps[0]:
            stamps.insert(0, first)
            poses.insert(0, self._continued(0, int(begin), first))
        if last > self.stamps[-1]:
            stamps.append(last)
            poses.append(self._continued(int(end), len(self.stamps) - 1, last))
        return EgoTrack(np.array(stamps, dtype=np.int64), np.stack(poses))

    def _continued(self, i: int, j: int, stamp: int) -> np.ndarray:
        fraction = float((stamp - self.stamps[i]) / (self.stamps[j] - self.stamps[i]))
        return interpolate(self.poses[i], self.poses[j], fraction)


def ego_track(tree: TransformTree, vehicle: str, world: str, vehicle_to_ego: Float64[np.ndarray, "4 4"]) -> EgoTrack:
    """The ego vehicle's path, at the times at which a transform between vehicle and world was recorded while all of
    them are known, at least KNOT_US apart. Raises DatasetError where there is none."""
    route = tree.require(vehicle, world)
    moving = [edge for edge, _ in route if not edge.latched and not edge.constant]
    moving = moving or [edge for edge, _ in route if not edge.latched]
    if not moving:
        raise DatasetError(
            f"the transform of {vehicle} to {world} holds at all times: there are no poses of the vehicle; record /tf, "
            "or name a topic of Odometry as poses in the map"
        )
    stamps = np.unique(np.concatenate([edge.stamps for edge in moving]))
    first, last = max(edge.stamps[0] for edge in moving), min(edge.stamps[-1] for edge in moving)
    stamps = stamps[(stamps >= first) & (stamps <= last)]
    if len(stamps) < 2:
        raise DatasetError(
            f"there are {len(stamps)} poses of {vehicle} in {world}, at least 2 are needed; record more of /tf, or "
            "widen --start and --end"
        )
    if np.diff(stamps).min() < KNOT_US:
        stamps = stamps[np.unique(stamps // KNOT_US, return_index=True)[1]]
    return EgoTrack(stamps, tree.poses(vehicle, world, stamps) @ inverse(vehicle_to_ego))
