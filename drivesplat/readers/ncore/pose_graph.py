"""The poses of a clip: rigid transforms between named frames of reference, constant or over time.

NCore's `T_a_b` maps points of `a` to `b`. Between two poses position is linear and rotation slerp, as NCore has it. All
is float64, whatever the type that is stored.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import checked_timestamp, checked_transform, require_increasing
from drivesplat.readers.record_names import shown
from drivesplat.scene.pose_path import PosePath
from drivesplat.scene.rigid import inverse

UPRIGHT = 0.94
"""Cosine of the largest angle between two vertical axes that are one up to a slope: 20 degrees."""


@dataclass(frozen=True)
class Edge:
    """The poses (n, 4, 4) of one frame of reference in another at increasing `times` (n,); one pose if constant."""

    poses: Float64[np.ndarray, "n 4 4"]
    times: Int64[np.ndarray, " n"] | None = None

    def at(self, times: np.ndarray) -> np.ndarray:
        """The poses (m, 4, 4) at times (m,) within those known."""
        if self.times is None:
            return np.repeat(self.poses, len(times), axis=0)
        return self._path.at(times)

    @cached_property
    def _path(self) -> PosePath:
        assert self.times is not None
        return PosePath(self.times, self.poses)


def constant_edge(pose: np.ndarray, record: str) -> Edge:
    """A constant transform. Raises DatasetError naming `record` if it is not rigid."""
    return Edge(checked_transform(pose.tolist(), record)[None])


def moving_edge(poses: np.ndarray, times: np.ndarray, record: str) -> Edge:
    """A transform over time. Raises DatasetError naming `record` and the first pose that is not rigid, or not later
    than the one before."""
    if poses.ndim != 3 or times.ndim != 1 or not 1 < len(poses) == len(times):
        raise DatasetError(f"{record}: it must have at least two poses, each with its time")
    names = [str(time) for time in times.tolist()]
    checked = [checked_transform(pose.tolist(), f"{record} at {name}") for pose, name in zip(poses, names, strict=True)]
    stamps = [checked_timestamp(time, record) for time in times.tolist()]
    return Edge(np.stack(checked), require_increasing(stamps, names, f"{record} at"))


class PoseGraph:
    """The transforms of a clip. `name` is that of the clip, for messages."""

    def __init__(self, name: str, edges: Iterable[tuple[tuple[str, str], Edge]]):
        self._name = name
        self._edges: dict[str, dict[str, tuple[Edge, bool]]] = {}
        for (source, target), edge in edges:
            self._edges.setdefault(source, {})[target] = edge, False
            self._edges.setdefault(target, {})[source] = edge, True

    def __contains__(self, frame: str) -> bool:
        return frame in self._edges

    def at(self, source: str, target: str, times: Iterable[int]) -> Float64[np.ndarray, "n 4 4"]:
        """`source` to `target` (n, 4, 4) at times in microseconds. Raises DatasetError where the two are not connected,
        and for a time at which the motion between them is unknown."""
        wanted = np.array(list(times), dtype=np.int64)
        found = np.repeat(np.eye(4)[None], len(wanted), axis=0)
        first, last = self.span(source, target)
        if len(wanted) and not first <= wanted.min() <= wanted.max() <= last:
            outside = wanted.min() if wanted.min() < first else wanted.max()
            raise DatasetError(
                f"clip {self._name}: the pose of {source} in {target} is known from {first:.0f} to {last:.0f}, not at "
                f"{outside}"
            )
        for edge, reverse in self._path(source, target):
            poses = edge.at(wanted)
            found = (inverse(poses) if reverse else poses) @ found
        return found

    def span(self, source: str, target: str) -> tuple[float, float]:
        """The first and the last time at which the pose of `source` in `target` is known; infinite where it is
        constant."""
        moving = [edge.times for edge, _ in self._path(source, target) if edge.times is not None]
        first = max((float(times[0]) for times in moving), default=-np.inf)
        return first, min((float(times[-1]) for times in moving), default=np.inf)

    def times_between(self, source: str, target: str, start: int, end: int) -> list[int]:
        """The times of the poses stored between `source` and `target` after `start` and before `end`, in order."""
        moving = [edge.times for edge, _ in self._path(source, target) if edge.times is not None]
        inside = (times[np.searchsorted(times, start, "right") : np.searchsorted(times, end)] for times in moving)
        return sorted({int(time) for times in inside for time in times})

    def _path(self, source: str, target: str) -> list[tuple[Edge, bool]]:
        """The transforms from `source` to `target`, and whether each has to be inverted."""
        for frame in (source, target):
            if frame not in self._edges:
                known = ", ".join(sorted(self._edges))[:200]
                raise DatasetError(
                    f"clip {self._name}: its poses have no frame of reference {shown(frame)}; there are: "
                    f"{known or 'none'}"
                )
        paths: dict[str, list[tuple[Edge, bool]]] = {source: []}
        for frame in (queue := [source]):
            for neighbour, edge in self._edges[frame].items():
                if neighbour not in paths:
                    paths[neighbour] = [*paths[frame], edge]
                    queue.append(neighbour)
        if target not in paths:
            raise DatasetError(f"clip {self._name}: no poses connect {shown(source)} with {shown(target)}")
        return paths[target]
