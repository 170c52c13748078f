"""Checks that the vehicles which an edit places are neither in a wall nor in another object."""

from itertools import pairwise

import numpy as np

from drivesplat.demo.optics.raycast import NO_HIT, Rays
from drivesplat.demo.recorder import Recorder, Viewpoint
from drivesplat.demo.street.objects import StreetObject
from drivesplat.errors import ConfigError
from drivesplat.scene.rigid import apply

CHECK_S = 0.1
"""Interval of the checks in seconds."""
CLEARANCE = 0.25
"""Height above the ground (metres) of the lowest rays through a vehicle; curbs are lower."""


def require_free_places(recorder: Recorder) -> None:
    """Raises ConfigError, one line, where a placed vehicle meets an object during the drive."""
    for name, edit in recorder.edits.items():
        for number, step in enumerate(edit.steps, start=1):
            if step.place is None:
                continue
            met = first_contact(recorder, name, step.place.name)
            if met is not None:
                raise ConfigError(
                    f"scene {recorder.scene}, edit {name!r}, step {number} (place): {step.place.name!r} is inside "
                    f"{met[1]} at {met[0]:.1f} s; choose another path"
                )


def first_contact(recorder: Recorder, edit: str, name: str) -> tuple[float, str] | None:
    """The first second at which the vehicle `name` of an edit touches an object, and that object's name; None if it
    touches none. Rays through its box find what is inside."""
    objects = recorder.variation(edit).street.objects
    placed = next((item for item in objects if item.name == name), None)
    if placed is None:  # a later step has removed it
        return None
    starts, ends = _lines_through(placed)
    for seconds in np.arange(0.0, recorder.world.seconds, CHECK_S):
        time = np.array([seconds])
        pose = placed.poses(time)[0]
        origins, toward = apply(pose, starts), (ends - starts) @ pose[:3, :3].T
        length = np.linalg.norm(toward, axis=1)
        rays = Rays(
            np.full(len(starts), seconds), origins, toward / length[:, None], np.arange(len(starts), dtype=np.int32)
        )
        hits = recorder.snapshot(rays.seconds, Viewpoint(edit=edit, without=name)).cast(rays)
        inside = (hits.object != NO_HIT) & (hits.distance < length)
        if inside.any():
            return float(seconds), objects[int(hits.object[np.flatnonzero(inside)[0]])].name
    return None


def _lines_through(item: StreetObject) -> tuple[np.ndarray, np.ndarray]:
    """Start and end points (n, 3) of lines through the box of an object, in its frame: its edges and diagonals at
    several heights."""
    length, width, height = item.size
    corners = np.array([(x, y) for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]) * [length / 2, width / 2]
    pairs = [*pairwise([*corners, corners[0]]), (corners[0], corners[2]), (corners[1], corners[3])]
    heights = np.linspace(CLEARANCE, 0.95 * height, 4)
    starts = [(*start, z) for start, _ in pairs for z in heights]
    ends = [(*end, z) for _, end in pairs for z in heights]
    return np.array(starts), np.array(ends)
