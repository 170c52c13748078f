"""The poses of annotated objects between their annotations."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import apply, interpolate, inverse
from drivesplat.scene.scene import Scene, Track

MIN_ID_LENGTH = 8
"""Minimum number of characters of a shortened id."""


UNIT_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""The corners (8, 3) of a box with edges of length 1, in the order of `Box.corners`."""


@dataclass(frozen=True)
class Box:
    """A track at one time: `size` (3,) length, width, height in metres, horizontal `speed` in m/s."""

    track_id: str
    object_class: ObjectClass
    category: str
    size: np.ndarray
    object_to_world: np.ndarray
    speed: float
    visibility: int

    @property
    def corners(self) -> np.ndarray:
        """The eight corners (8, 3) in world coordinates; index bits 2, 1, 0 are the signs of x, y, z."""
        return (UNIT_CORNERS * self.size) @ self.object_to_world[:3, :3].T + self.object_to_world[:3, 3]

    def contains(self, points: np.ndarray, margin: float = 0.0, floor: float = 0.0) -> np.ndarray:
        """Whether world points (n, 3) lie in the box, with its sides and roof expanded by `margin` metres and its floor
        raised by `floor` metres: (n,) bool."""
        return in_box(points, self.object_to_world, self.size, margin, floor)

    @property
    def moves(self) -> bool:
        """Whether it moves at this time, by the measuring protocol's threshold for its class."""
        return self.object_class.moves_at(self.speed)


def in_box(
    points: np.ndarray, object_to_world: np.ndarray, size: np.ndarray, margin: float = 0.0, floor: float = 0.0
) -> np.ndarray:
    """Whether world points (n, 3) lie in a box of `size` (3,) at a pose (4, 4), with its sides and roof expanded by
    `margin` metres and its floor raised by `floor` metres: (n,) bool."""
    inside = np.zeros(len(points), dtype=bool)
    reach = np.linalg.norm(size) / 2 + 2 * max(margin, -floor, 0.0)
    near = np.flatnonzero(np.linalg.norm(points - object_to_world[:3, 3], axis=1) < reach)
    in_object = apply(inverse(object_to_world), points[near])
    inside[near] = (np.abs(in_object[:, :2]) < size[:2] / 2 + margin).all(axis=1)
    inside[near] &= (in_object[:, 2] > floor - size[2] / 2) & (in_object[:, 2] < size[2] / 2 + margin)
    return inside


def box_at(track: Track, timestamp: int, interval: float) -> Box | None:
    """The box of `track` at `timestamp` (microseconds), or None if it is absent.

    Between consecutive annotated key frames, the position is interpolated linearly and the rotation by slerp. Up to
    half an `interval` (microseconds, the scene's key-frame interval) beyond an end, the motion of the last segment
    continues; a single box is static. At a gap in the annotations the track ends, and a new run begins after it.
    """
    for first, last in runs(track.sample_indices):
        times = track.timestamps[first : last + 1]
        reach = interval / 2.0
        if not times[0] - reach <= timestamp <= times[-1] + reach:
            continue
        nearest = first + int(np.argmin(np.abs(times - timestamp)))
        pose, speed = track.object_to_world[first], 0.0
        if first < last:
            segment = first + int(np.clip(np.searchsorted(times, timestamp, side="right") - 1, 0, last - first - 1))
            start, end = track.object_to_world[segment], track.object_to_world[segment + 1]
            duration = float(track.timestamps[segment + 1] - track.timestamps[segment])
            pose = interpolate(start, end, (timestamp - track.timestamps[segment]) / duration)
            speed = float(np.linalg.norm((end - start)[:2, 3])) / duration * 1e6
        visibility = int(track.visibility[nearest])
        return Box(track.id, track.object_class, track.category, track.size, pose, speed, visibility)
    return None


def boxes_of(tracks: Iterable[Track], timestamp: int, interval: float) -> list[Box]:
    """The boxes of `tracks` present at `timestamp`; `interval` is the key-frame interval, both in microseconds."""
    boxes = (box_at(track, timestamp, interval) for track in tracks)
    return [box for box in boxes if box is not None]


def boxes_at(scene: Scene, timestamp: int) -> list[Box]:
    """All boxes of a scene at `timestamp` (microseconds)."""
    return boxes_of(scene.tracks, timestamp, scene.key_frame_interval)


def ever_moves(track: Track) -> bool:
    """Whether a track moves at any annotation, by the thresholds of `Box.moves`."""
    times = track.timestamps
    for first, last in runs(track.sample_indices):
        if any(box_at(track, int(time), 0.0).moves for time in times[first:last]):
            return True
    return False


def moving_tracks(scene: Scene) -> list[Track]:
    """The tracks that move at any time in a scene."""
    return [track for track in scene.tracks if ever_moves(track)]


def runs(sample_indices: np.ndarray) -> list[tuple[int, int]]:
    """The first and last position of every run of consecutive key frames."""
    breaks = np.flatnonzero(np.diff(sample_indices) != 1).tolist()
    return list(zip([0, *(i + 1 for i in breaks)], [*breaks, len(sample_indices) - 1], strict=True))


def matching_ids(name: str, ids: Collection[str]) -> list[str]:
    """The id `name` itself where it is one of `ids`, otherwise all that start with it."""
    return [name] if name in ids else [known for known in ids if known.startswith(name)]


def short_ids(ids: Sequence[str]) -> dict[str, str]:
    """Shortened ids by id: at least MIN_ID_LENGTH characters, and as many as make them unique."""
    longest = max(map(len, ids), default=0)
    unique = (n for n in range(MIN_ID_LENGTH, longest) if len({name[:n] for name in ids}) == len(ids))
    length = next(unique, longest)
    return {name: name[:length] for name in ids}
