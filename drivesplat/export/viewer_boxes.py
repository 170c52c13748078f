"""Boxes of annotated objects for viewer.html: sampled motions, without the samples that interpolation replaces.

The page interpolates the entries of poses linearly. An object that stands still keeps two samples.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from drivesplat.export.sampled_motion import sample_motion
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import UNIT_CORNERS
from drivesplat.trajectories.motion import Motion

TOLERANCE = 0.02
"""Metres by which the corners of an interpolated box may deviate."""


@dataclass(frozen=True)
class BoxMotion:
    """The box of a track: poses `object_to_world` (n, 4, 4) at `seconds` (n,) since the first image, to interpolate
    linearly; the object is present during `spans`."""

    track: Track
    seconds: Float[np.ndarray, " n"]
    object_to_world: Float[np.ndarray, "n 4 4"]
    spans: tuple[tuple[float, float], ...]


def box_motions(scene: Scene, groups: Collection[str]) -> list[BoxMotion]:
    """The boxes of all annotated tracks of a scene, of every class, except those named in `groups`, whose motions the
    page has anyway."""
    found = []
    for track in scene.tracks:
        if track.id in groups or not len(track.timestamps):
            continue
        motion = Motion.of_track(scene, track)
        sampled = sample_motion(motion, motion.times, float(motion.times[0]))
        kept = needed_samples(sampled.seconds, sampled.object_to_world, track.size)
        found.append(BoxMotion(track, sampled.seconds[kept], sampled.object_to_world[kept], sampled.spans))
    return found


def needed_samples(
    seconds: Float[np.ndarray, " n"], poses: Float[np.ndarray, "n 4 4"], size: Float[np.ndarray, "3"]
) -> Int[np.ndarray, " m"]:
    """The indices (m,) of the samples from which linear interpolation gives all corners of a box of `size` (3,) within
    TOLERANCE: from the first to the last, each as far from the one before as possible."""
    corners = np.einsum("nij,kj->nki", poses[:, :3, :3], UNIT_CORNERS * size) + poses[:, None, :3, 3]  # (n, 8, 3)
    kept = [0]
    for last in range(2, len(seconds)):
        first = kept[-1]
        between = slice(first + 1, last)
        share = ((seconds[between] - seconds[first]) / (seconds[last] - seconds[first]))[:, None, None]
        lines = (1.0 - share) * corners[first] + share * corners[last]
        if np.linalg.norm(lines - corners[between], axis=-1).max(initial=0.0) > TOLERANCE:
            kept.append(last - 1)
    return np.array(kept if len(seconds) == 1 else [*kept, len(seconds) - 1])
