"""A recorded path as a reference: how far along it, and how far beside it, places are."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

MIN_SEGMENT = 0.5
"""Metres between successive vertices: a standing vehicle adds no length by the noise of its poses."""
WINDOW = 10.0
"""Metres along the path that a projection may move from one step to the next beyond the distance driven."""
BEYOND = 1e5
"""Metres by which the path goes on straight before its begin and after its end."""


@dataclass(frozen=True, eq=False)
class PathPlaces:
    """Projections of n places onto a path: `arc` metres along it from its begin (negative before it, more than its
    length after its end), `offset` metres beside it (positive to the left), and `tangent`, its direction there."""

    arc: Float64[np.ndarray, " n"]
    offset: Float64[np.ndarray, " n"]
    tangent: Float64[np.ndarray, "n 2"]


class ReferencePath:
    """The horizontal path of poses (m, 4, 4) at increasing `seconds` (m,), as a polyline.

    Before its begin and after its end it goes on straight; a vehicle that stood all the time has a path of length 0,
    which goes on along its heading.
    """

    def __init__(self, poses: Float64[np.ndarray, "m 4 4"], seconds: Float64[np.ndarray, " m"]):
        vertices = _thinned(poses[:, :2, 3])
        heading = poses[0, :2, 0] / np.linalg.norm(poses[0, :2, 0])
        first, last = (vertices[1] - vertices[0], vertices[-1] - vertices[-2]) if len(vertices) > 1 else [heading] * 2
        first, last = first / np.linalg.norm(first), last / np.linalg.norm(last)
        steps = np.diff(vertices, axis=0)
        self.vertices = vertices
        self.length = float(np.linalg.norm(steps, axis=1).sum())
        self._starts = np.concatenate([vertices[:1] - BEYOND * first, vertices])
        self._lengths = np.concatenate([[BEYOND], np.linalg.norm(steps, axis=1), [BEYOND]])
        self._directions = np.concatenate([[first], steps / self._lengths[1:-1, None], [last]])
        self._arcs = np.concatenate([[-BEYOND, 0.0], np.cumsum(self._lengths[1:-1])])
        self._seconds, self._recorded = seconds, poses[:, :3, 3]
        self._recorded_arcs = self.track(poses[:, :2, 3], 0.0).arc

    def arcs_at(self, seconds: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """How far along the path the recorded vehicle was at n times, metres; NaN before and after the recording."""
        return np.interp(seconds, self._seconds, self._recorded_arcs, left=np.nan, right=np.nan)

    def places_at(self, seconds: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 2"]:
        """Where the recorded vehicle was at n times, by linear interpolation; NaN before and after the recording."""
        along = [np.interp(seconds, self._seconds, self._recorded[:, i], left=np.nan, right=np.nan) for i in (0, 1)]
        return np.stack(along, axis=-1)

    def begin(self, second: float) -> float:
        """Where to begin to `track`: how far along the path the recorded vehicle was, metres."""
        return float(np.interp(second, self._seconds, self._recorded_arcs))

    def at(self, arcs: Float64[np.ndarray, " n"]) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]:
        """The places at metres along the path, and its directions there."""
        segments = (np.searchsorted(self._arcs, arcs, side="right") - 1).clip(min=0)
        directions = self._directions[segments]
        return self._starts[segments] + (arcs - self._arcs[segments])[:, None] * directions, directions

    def follow(self, place: Float64[np.ndarray, "2"], arc: float, driven: float) -> tuple[float, float]:
        """How far along the path (metres) a place is, and how far beside it (positive to the left), that was reached
        from `arc` metres along it after `driven` metres: see `track`."""
        arcs, offsets, _ = self._nearest(place[None], arc, driven + WINDOW)
        return float(arcs[0]), float(offsets[0])

    def track(self, places: Float64[np.ndarray, "n 2"], begin: float) -> PathPlaces:
        """The projections of successive places, of which the first is near `begin` metres along the path.

        Each is the nearest place of the path within WINDOW and the distance driven, along the path, of the one before
        it. So a path that crosses itself or runs in circles is followed on the right branch, a standing vehicle keeps
        its place, and one that reverses goes back.
        """
        driven = np.concatenate([[0.0], np.linalg.norm(np.diff(places, axis=0), axis=1)])
        arcs, offsets, tangents = np.zeros(len(places)), np.zeros(len(places)), np.zeros((len(places), 2))
        arc = begin
        for i, place in enumerate(places):
            arc, offset, segment = self._nearest(place[None], arc, driven[i] + WINDOW)
            arc = arcs[i] = arc[0]
            offsets[i], tangents[i] = offset[0], self._directions[segment[0]]
        return PathPlaces(arcs, offsets, tangents)

    def distances(
        self, places: Float64[np.ndarray, "n q 2"], arcs: Float64[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "n q"]:
        """Metres from n groups of q places to the nearest place of the path within WINDOW of `arcs`, along it."""
        found = [np.abs(self._nearest(group, arc, WINDOW)[1]) for group, arc in zip(places, arcs, strict=True)]
        return np.array(found).reshape(places.shape[:2])

    def distances_with_ends(self, places: Float64[np.ndarray, "n 2"], on_path: PathPlaces) -> Float64[np.ndarray, " n"]:
        """Metres from places to the recorded part of the path: as `on_path`, but beyond an end the distance to it."""
        ends = np.where((on_path.arc < 0.0)[:, None], self.vertices[0], self.vertices[-1])
        beyond = (on_path.arc < 0.0) | (on_path.arc > self.length)
        return np.where(beyond, np.linalg.norm(places - ends, axis=1), np.abs(on_path.offset))

    def _nearest(self, places: np.ndarray, arc: float, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of places (q, 2) the arcs, signed offsets and segments of the nearest place on segments within `reach`."""
        first = max(int(np.searchsorted(self._arcs, arc - reach, side="right")) - 1, 0)
        last = int(np.searchsorted(self._arcs, arc + reach, side="right"))
        directions, lengths = self._directions[first:last], self._lengths[first:last]
        x, y = np.moveaxis(places[:, None] - self._starts[first:last], -1, 0)
        along = np.clip(x * directions[:, 0] + y * directions[:, 1], 0.0, lengths)
        beside = directions[:, 0] * y - directions[:, 1] * x
        distance = np.hypot(x - along * directions[:, 0], y - along * directions[:, 1])
        chosen, rows = distance.argmin(axis=1), np.arange(len(places))
        arcs = self._arcs[first + chosen] + along[rows, chosen]
        return arcs, np.copysign(distance[rows, chosen], beside[rows, chosen]), first + chosen


def _thinned(places: np.ndarray) -> np.ndarray:
    """Of successive places (m, 2) those at least MIN_SEGMENT from the one before, and the last where it moved."""
    kept = [0]
    for i, place in enumerate(places):
        if np.linalg.norm(place - places[kept[-1]]) >= MIN_SEGMENT:
            kept.append(i)
    if len(kept) > 1 and kept[-1] != len(places) - 1:
        kept[-1:] = [len(places) - 1] if len(kept) > 2 else [kept[-1], len(places) - 1]
    vertices = places[kept]
    return vertices[np.concatenate([[True], (np.diff(vertices, axis=0) != 0.0).any(axis=1)])]
