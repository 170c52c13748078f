"""Checks that the vehicles which an edit places are neither in a wall nor in another object."""

from itertools import pairwise

import numpy as np

from drivesplat.errors import ConfigError
from drivesplat.world.optics.raycast import NO_HIT, StreetRays
from drivesplat.world.recorder import Recorder, Viewpoint

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
    # lines through the vehicle's box, in its frame: its edges and diagonals at several heights
    length, width, height = placed.size
    corners = np.array([(x, y) for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]) * [length / 2, width / 2]
    pairs = [*pairwise([*corners, corners[0]]), (corners[0], corners[2]), (corners[1], corners[3])]
    heights = np.linspace(CLEARANCE, 0.95 * height, 4)
    starts = np.array([(*start, z) for start, _ in pairs for z in heights])
    ends = np.array([(*end, z) for _, end in pairs for z in heights])
    times = np.arange(0.0, recorder.world.seconds, CHECK_S)
    poses = np.repeat(placed.poses(times), len(starts), axis=0)
    start, toward = np.tile(starts, (len(times), 1)), np.tile(ends - starts, (len(times), 1))
    length = np.linalg.norm(toward, axis=1)
    origins = np.einsum("nij,nj->ni", poses[:, :3, :3], start) + poses[:, :3, 3]
    directions = np.einsum("nij,nj->ni", poses[:, :3, :3], toward / length[:, None])
    rays = StreetRays(np.repeat(times, len(starts)), origins, directions, np.arange(len(poses), dtype=np.int32))
    hits = recorder.snapshot(rays.seconds, Viewpoint(edit=edit, without=name)).cast(rays)
    inside = np.flatnonzero((hits.object != NO_HIT) & (hits.distance < length))
    if len(inside) == 0:
        return None
    return float(rays.seconds[inside[0]]), objects[int(hits.object[inside[0]])].name
