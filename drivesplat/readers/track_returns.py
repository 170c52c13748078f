"""What LiDAR returns say against the boxes of tracks: their floors, frame, heading and clock, in sentences. These are
warnings."""

from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from drivesplat.readers.record_names import counted
from drivesplat.readers.sampled_sweeps import SampledSweep, ego_pose
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import Box, boxes_at, in_box

REACH = 40.0
"""Metres from the LiDAR within which boxes are compared with returns."""
AROUND, MIN_AROUND = 3.0, 20
"""The LiDAR sees the surroundings of a box if it has this many returns within this distance (metres) of the box."""
MIN_INSIDE, LIFTED, MARGIN, BESIDE = 5, 0.25, 0.1, 1.0
"""A box holds returns if this many lie above its lowest LIFTED metres, and more of them within MARGIN metres of it than
from there to BESIDE metres."""
MIN_BOXES, MIN_FILLED, BETTER = 5, 0.25, 2.0
"""Boxes from which on a warning is given; the share of them that must be filled; the factor by which boxes in another
frame are filled more often."""
GROUND_RING, GROUND_REACH, GROUND_PERCENT = (0.3, 2.5), 25.0, 10
"""Between these distances (metres) from a box, and within this distance from the LiDAR, this percentile of the heights
of returns is the ground."""
MAX_FLOOR = 0.35
"""Metres between the floors of boxes and the ground, and median deviation from there of boxes that are all too low."""
SHIFTS = np.round(np.arange(-1.0, 1.025, 0.05), 2)
"""Seconds by which boxes are shifted to find the clock of tracks."""
NEAR, MIN_NEAR = 0.25, 20
"""Metres from the visible sides of a box at which returns lose weight (Gaussian); returns that are needed."""
MIN_SHIFT, MIN_WAY, MAX_RATIO = 0.1, 0.5, 0.8
"""A shift is reported from this time (seconds) and way (metres) on, where boxes as given reach at most this share of
the score."""
ELONGATED, MIN_TURNED, MAX_TURNED = 1.5, 3, 0.7
"""Length by width of a box from which on a turn by 90 degrees can be seen; tracks that are needed, and the share of
them from which on they are taken to be turned."""
STEP_US = 100_000
"""Microseconds to the boxes by which the velocity of an object is computed."""


class _Seen(NamedTuple):
    """A box at the time of a sweep. `points` (n, 3) of the sweep around it, at `offsets_s` (n,) after the sweep's
    timestamp, the position of the `sensor` (3,) and the object's `velocity` (3,) in m/s, all in the frame of the box.
    """

    box: Box
    points: np.ndarray
    offsets_s: np.ndarray
    sensor: np.ndarray
    velocity: np.ndarray


def frame_warnings(scene: Scene, sweeps: list[SampledSweep]) -> list[str]:
    """A sentence where more boxes hold returns if they are taken to be in the ego frame or the LiDAR's."""
    states = {name: _filled(scene, sweeps, name) for name in ("world", "ego", "LiDAR")}
    given, best = sum(states["world"]), max(("ego", "LiDAR"), key=lambda name: sum(states[name]))
    found = sum(states[best])
    if found <= BETTER * given + MIN_BOXES or found < MIN_FILLED * len(states[best]):
        return []
    return [
        f"tracks: {found} of {len(states[best])} boxes at sampled sweeps hold LiDAR returns if poses of tracks are "
        f"taken to be in the {best} frame, and {given} of {len(states['world'])} as they are: they must be in the world"
    ]


def box_warnings(scene: Scene, sweeps: list[SampledSweep]) -> list[str]:
    """Sentences about tracks whose boxes do not hold the returns of their objects: the first mistake that is found,
    since it causes others."""
    seen = [one for sweep in sweeps for one in _around_boxes(scene, sweep)]
    if found := list(_floor_warnings(seen)):
        return found
    filled = _filled(scene, sweeps, "world")
    if len(filled) >= MIN_BOXES and sum(filled) < MIN_FILLED * len(filled):
        return [
            f"tracks: hardly a LiDAR return lies in boxes: {sum(filled)} of {len(filled)} at sampled sweeps hold some, "
            "though there are returns around: check the frame, unit and times of tracks"
        ]
    return list(_turn_warnings(seen)) or list(_clock_warnings(seen))


def _around_boxes(scene: Scene, sampled: SampledSweep) -> Iterator[_Seen]:
    time, sensor = sampled.sweep.timestamp, sampled.sweep.sensor_to_world[:3, 3]
    others = [{box.track_id: box for box in boxes_at(scene, time + step)} for step in (-STEP_US, STEP_US)]
    for box in boxes_at(scene, time):
        center = box.object_to_world[:3, 3]
        if np.linalg.norm(center - sensor) > REACH:
            continue
        before, after = (known.get(box.track_id, box) for known in others)
        steps = (before is not box) + (after is not box)
        moved = after.object_to_world[:3, 3] - before.object_to_world[:3, 3]
        velocity = moved / (max(steps, 1) * STEP_US * 1e-6)
        reach = np.linalg.norm(box.size) / 2 + max(AROUND, SHIFTS[-1] * box.speed + 1.0)
        near = np.linalg.norm(sampled.points[:, :2] - center[:2], axis=1) < reach
        to_box = inverse(box.object_to_world)
        points, at = apply(to_box, sampled.points[near]), apply(to_box, sensor)
        yield _Seen(box, points, sampled.offsets_s[near], at, to_box[:3, :3] @ velocity)


def _filled(scene: Scene, sweeps: list[SampledSweep], frame: str) -> list[bool]:
    """Whether the boxes hold returns, and more than there are beside them, if poses of tracks are taken to be in a
    frame ('world', 'ego' or 'LiDAR'): of all boxes at all sweeps whose surroundings a LiDAR sees."""
    states = []
    for sampled in sweeps:
        to_world = np.eye(4)
        if frame != "world":
            to_world = ego_pose(scene, sampled.sweep) if frame == "ego" else sampled.sweep.sensor_to_world
        boxes = (box for box in boxes_at(scene, sampled.sweep.timestamp) if box.object_class.is_dynamic)
        for box in boxes:
            pose = to_world @ box.object_to_world
            offset = np.linalg.norm(sampled.points[:, :2] - pose[:2, 3], axis=1)
            near = sampled.points[offset < np.linalg.norm(box.size) / 2 + AROUND]
            away = np.linalg.norm(pose[:3, 3] - sampled.sweep.sensor_to_world[:3, 3])
            if len(near) >= MIN_AROUND and away <= REACH:
                inside, around = (int(in_box(near, pose, box.size, by, LIFTED).sum()) for by in (MARGIN, BESIDE))
                states.append(inside >= MIN_INSIDE and inside > around / 2)
    return states


def _floor_warnings(seen: list[_Seen]) -> Iterator[str]:
    heights = defaultdict(list)
    for box, points, _, sensor, _ in seen:
        outside = np.hypot(*np.maximum(np.abs(points[:, :2]) - box.size[:2] / 2, 0.0).T)
        ring = (outside > GROUND_RING[0]) & (outside < GROUND_RING[1])
        if ring.sum() >= MIN_AROUND and np.linalg.norm(sensor) < GROUND_REACH:
            heights[box.track_id].append(-box.size[2] / 2 - np.percentile(points[ring, 2], GROUND_PERCENT))
    floors = [float(np.median(of_track)) for of_track in heights.values()]
    if not floors:
        return
    height = float(np.median(floors))
    if abs(height) > MAX_FLOOR and np.median(np.abs(np.array(floors) - height)) < MAX_FLOOR:
        yield (
            f"tracks: the floors of boxes lie {abs(height):.2f} m {'below' if height < 0 else 'above'} the ground "
            f"(median of {counted(len(floors), 'track')}): poses are those of the centre of the box, not of its bottom"
        )


def _turn_warnings(seen: list[_Seen]) -> Iterator[str]:
    """Long vehicles whose returns lie on the sides of the box after it is turned by 90 degrees."""
    better = defaultdict(list)
    for box, points, _, sensor, _ in seen:
        if box.object_class.is_solid and box.size[0] > ELONGATED * box.size[1] and len(points) >= MIN_NEAR:
            raised = points[_at_height(points, box)]
            given = _on_sides(raised, box.size, sensor)
            turned = _on_sides(raised[:, [1, 0, 2]], box.size, sensor[[1, 0, 2]])
            if max(given, turned) >= MIN_NEAR:
                better[box.track_id].append(turned > given)
    tracks = [np.mean(of_track) > 0.5 for of_track in better.values()]
    if len(tracks) >= MIN_TURNED and np.mean(tracks) > MAX_TURNED:
        yield (
            f"tracks: the boxes of {sum(tracks)} of {counted(len(tracks), 'long vehicle')} fit the returns better if "
            "they are turned by 90 degrees: x of a box points forward, and size is length, width, height"
        )


def _clock_warnings(seen: list[_Seen]) -> Iterator[str]:
    """Moving vehicles whose returns lie on the sides of the box at another time."""
    scores, speeds = defaultdict(list), defaultdict(list)
    for box, points, offsets_s, sensor, velocity in seen:
        if box.object_class.is_solid and box.moves:
            raised = _at_height(points, box)
            still = points[raised] - offsets_s[raised, None] * velocity
            score = np.array([_on_sides(still - s * velocity, box.size, sensor - s * velocity) for s in SHIFTS])
            if score.max() >= MIN_NEAR:
                scores[box.track_id].append(score / score.max())
                speeds[box.track_id].append(box.speed)
    sums = [np.sum(of_track, axis=0) for of_track in scores.values()]
    if not sums:
        return
    shift = float(np.median([SHIFTS[np.argmax(score)] for score in sums]))
    ratio = float(np.median([score[np.argmin(np.abs(SHIFTS))] / score.max() for score in sums]))
    way = abs(shift) * float(np.median(np.concatenate(list(speeds.values()))))
    if abs(shift) >= MIN_SHIFT and way >= MIN_WAY and ratio < MAX_RATIO:
        yield (
            f"tracks: boxes of moving vehicles fit the LiDAR returns better {abs(shift):.2f} s "
            f"{'later' if shift > 0 else 'earlier'} on their paths (median of {counted(len(sums), 'track')}): "
            f"timestamps of tracks seem to be {abs(shift):.2f} s too {'late' if shift > 0 else 'early'}"
        )


def _at_height(points: np.ndarray, box: Box) -> np.ndarray:
    """Which points (n, 3) in the frame of a box are as high as it, and not on the ground: (n,) bool."""
    return (points[:, 2] > LIFTED - box.size[2] / 2) & (points[:, 2] < box.size[2] / 2)


def _on_sides(points: np.ndarray, size: np.ndarray, sensor: np.ndarray) -> float:
    """The weighted number of points (n, 3) on the upright sides of a box that face the sensor, in the frame of the
    box."""
    weights = np.zeros(len(points))
    for axis, other in ((0, 1), (1, 0)):
        if abs(sensor[axis]) > size[axis] / 2:
            offset = points[:, axis] * np.sign(sensor[axis]) - size[axis] / 2
            beside = np.maximum(np.abs(points[:, other]) - size[other] / 2, 0.0)
            weights = np.maximum(weights, np.exp(-(np.square(offset) + np.square(beside)) / NEAR**2))
    return float(weights.sum())
