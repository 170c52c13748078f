"""What tracks alone say against their rotations, sizes and frame, in sentences. These are warnings."""

from collections.abc import Sequence

import numpy as np

from drivesplat.readers.record_names import counted
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import apply
from drivesplat.scene.scene import Scene, Track

MAX_TILT, MAX_TILTED = 15.0, 0.1
"""Degrees between the z axes of a box and the world; share of the tracks that may be tilted by more."""
MIN_SPEED, MIN_STEPS = 2.0, 2
"""Horizontal speed in m/s, and number of steps at it, from which on the motion of a vehicle gives its heading."""
MAX_TURN = 30.0
"""Degrees between the x axis of a vehicle and its motion."""
STANDING, MIN_TRACKS, MANY, FEW = 0.7, 4, 0.5, 0.2
"""Speed in m/s below which an object stands; tracks that are needed to find their frame; shares of them that stand in
the right frame and in a wrong one."""
_CYCLE = (0.8, 3.5), (0.2, 1.6), (0.6, 2.6)
_ANY_VEHICLE = (0.8, 60.0), (0.3, 6.0), (0.5, 6.5)
SIZES = {
    ObjectClass.CAR: ((2.3, 8.5), (1.1, 3.5), (0.9, 3.5)),
    ObjectClass.TRUCK: ((3.0, 30.0), (1.3, 5.5), (1.2, 6.0)),
    ObjectClass.BUS: ((4.0, 30.0), (1.5, 5.5), (1.8, 6.0)),
    ObjectClass.TRAM: ((5.0, 80.0), (1.5, 5.5), (2.0, 6.0)),
    ObjectClass.TRAILER: _ANY_VEHICLE,
    ObjectClass.CONSTRUCTION_VEHICLE: _ANY_VEHICLE,
    ObjectClass.VEHICLE: _ANY_VEHICLE,
    ObjectClass.MOTORCYCLE: _CYCLE,
    ObjectClass.BICYCLE: _CYCLE,
    ObjectClass.RIDER: _CYCLE,
    ObjectClass.PEDESTRIAN: ((0.15, 2.2), (0.15, 2.2), (0.6, 2.5)),
}
"""Bounds in metres of the median length, width and height of the boxes of a class."""


def shape_warnings(tracks: Sequence[Track]) -> list[str]:
    """Sentences about tracks whose boxes are tilted, or have sizes that their class has not."""
    found = []
    tilts = np.array([np.median(degrees_between(track.object_to_world[:, 2, 2])) for track in tracks])
    tilted = tilts[tilts > MAX_TILT]
    if len(tilted) > MAX_TILTED * len(tracks):
        found.append(
            f"tracks: the z axes of {len(tilted)} of {counted(len(tracks), 'track')} are tilted by "
            f"{np.median(tilted):.0f} degrees (median): they must point up; check that rotations of tracks are w, x, "
            "y, z and map the object's frame to the world"
        )
    for kind in dict.fromkeys(track.object_class for track in tracks):
        sizes = np.stack([track.size for track in tracks if track.object_class is kind])
        if kind not in SIZES:
            continue
        wide, median = int((sizes[:, 0] < sizes[:, 1]).sum()), np.median(sizes, axis=0)
        if kind.is_vehicle and wide > len(sizes) / 2:
            found.append(
                f"tracks: length < width for {wide} of {counted(len(sizes), 'track')} of class {kind.value}: size is "
                "length, width, height"
            )
        elif not all(low <= value <= high for value, (low, high) in zip(median, SIZES[kind], strict=True)):
            shown = " x ".join(f"{value:.3g}" for value in median)
            found.append(
                f"tracks: boxes of class {kind.value} are {shown} m (median of {counted(len(sizes), 'track')}), which "
                "none is: size is the whole length, width and height in metres"
            )
    return found


def path_warnings(scene: Scene) -> list[str]:
    """A sentence about tracks most of which stand still if they are taken to be in the ego frame, while hardly one does
    as it is; or about vehicles that do not move along their x axes."""
    frames = sorted({frame.timestamp: frame for frame in scene.frames}.items())
    times = np.array([time for time, _ in frames])
    given, in_ego = [], []
    for track in scene.tracks if frames else ():
        nearest = [frames[int(np.argmin(np.abs(times - time)))][1] for time in track.timestamps]
        if len(nearest) < 2:
            continue
        places = track.object_to_world[:, :3, 3]
        moved = np.stack([apply(f.ego_to_world, place[None])[0] for f, place in zip(nearest, places, strict=True)])
        seconds = np.diff(track.timestamps) * 1e-6
        for found, path in ((given, places), (in_ego, moved)):
            found.append(float(np.median(np.linalg.norm(np.diff(path, axis=0), axis=1) / seconds)) < STANDING)
    if len(given) >= MIN_TRACKS and np.mean(in_ego) > MANY > FEW > np.mean(given):
        return [
            f"tracks: {sum(in_ego)} of {len(given)} stand still if their poses are taken to be in the ego frame, and "
            f"{sum(given)} as they are: they must be in the world"
        ]
    angles = []
    for track in scene.tracks:
        steps = np.diff(track.object_to_world[:, :2, 3], axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        fast = lengths > MIN_SPEED * 1e-6 * np.diff(track.timestamps)
        if track.object_class.is_vehicle and fast.sum() >= MIN_STEPS:
            headings = track.object_to_world[:-1, :2, 0][fast]
            norms = np.maximum(np.linalg.norm(headings, axis=1), 1e-9) * lengths[fast]
            angles.append(np.median(degrees_between((headings * steps[fast]).sum(axis=1) / norms)))
    if not angles or np.median(angles) <= MAX_TURN:
        return []
    return [
        f"tracks: {counted(len(angles), 'moving vehicle')} move{'s' if len(angles) == 1 else ''} at "
        f"{np.median(angles):.0f} degrees to the x axis of the box (median): x must point forward; check the direction "
        "of headings, and that rotations of tracks are w, x, y, z"
    ]


def degrees_between(cosines: np.ndarray) -> np.ndarray:
    """Angles in degrees of their cosines."""
    return np.degrees(np.arccos(cosines.clip(-1.0, 1.0)))
