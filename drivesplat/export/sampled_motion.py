"""Motions as densely sampled poses, and deformations as sampled shapes, for other programs.

Samples are taken thirty times a second, at annotations and at recorded images. Programs interpolate matrices entry by
entry; with this spacing points of a vehicle deviate by about a millimetre. Shapes, which need more space, are sampled
fifteen times a second: interpolated linearly, a swing of 1 Hz loses 2 % of its width, and one of 2 Hz 9 %.
"""

from dataclasses import dataclass

import numpy as np

from drivesplat.trajectories.motion import Motion

SAMPLES_PER_SECOND = 30
SHAPES_PER_SECOND = 15
_MICROSECOND = 1e-6


@dataclass(frozen=True)
class SampledMotion:
    """Poses `object_to_world` (n, 4, 4) at `seconds` (n,), whole microseconds since the first image.

    The object is present only during `spans`, each from its first to its last second, and has no samples outside.
    `default_time` is the second that programs without time show.
    """

    seconds: np.ndarray
    object_to_world: np.ndarray
    spans: tuple[tuple[float, float], ...]
    default_time: float

    @property
    def default_pose(self) -> np.ndarray:
        """The pose (4, 4) at `default_time`; if the object is absent then, the nearest one in time."""
        return self.object_to_world[np.abs(self.seconds - self.default_time).argmin()]

    @property
    def present_by_default(self) -> bool:
        return any(first <= self.default_time <= last for first, last in self.spans)


@dataclass(frozen=True)
class SampledShapes:
    """The centres `means` (t, n, 3) in metres and unit quaternions `quats` (t, n, 4) of n Gaussians in the frame of
    their object at `seconds` (t,) since the first image."""

    seconds: np.ndarray
    means: np.ndarray
    quats: np.ndarray


def shape_seconds(motion: SampledMotion) -> np.ndarray:
    """The seconds (t,) at which shapes are sampled: evenly within the spans of presence, and at their ends."""
    found = []
    for first, last in motion.spans:
        inside = np.arange(np.ceil(first * SHAPES_PER_SECOND), last * SHAPES_PER_SECOND) / SHAPES_PER_SECOND
        found.append(np.concatenate([[first], inside, [last]]))
    return np.unique(np.round(np.concatenate(found), 6))


def sample_motion(motion: Motion, recorded: np.ndarray, default_time: float) -> SampledMotion:
    """Samples a motion while the object is present, among others at the seconds `recorded` (m,) and `default_time`."""
    spans: list[tuple[float, float]] = []
    for start, stop in motion.runs:
        begin, end = float(motion.times[start] - motion.reach), float(motion.times[stop] + motion.reach)
        if spans and begin <= spans[-1][1]:
            begin = spans.pop()[0]
        spans.append((begin, end))
    first, last = motion.span
    regular = np.arange(np.ceil(first * SAMPLES_PER_SECOND), last * SAMPLES_PER_SECOND) / SAMPLES_PER_SECOND
    times = np.concatenate([regular, motion.times, recorded, [default_time], np.ravel(spans)])
    seconds = np.unique(np.round(times, 6))
    near = [(low - _MICROSECOND < seconds) & (seconds < high + _MICROSECOND) for low, high in spans]
    seconds = seconds[np.any(near, axis=0)]
    return SampledMotion(seconds, motion.poses(seconds), tuple(spans), default_time)
