"""A motion as densely sampled poses for other programs.

Samples are taken thirty times a second, at annotations and at recorded images. Programs interpolate matrices entry by
entry; with this spacing points of a vehicle deviate by about a millimetre.
"""

from dataclasses import dataclass

import numpy as np

from drivesplat.scene.motion import Motion

SAMPLES_PER_SECOND = 30
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


def sample_motion(motion: Motion, recorded: np.ndarray, default_time: float) -> SampledMotion:
    """Samples a motion while the object is present, among others at the seconds `recorded` (m,) and `default_time`."""
    first, last = motion.span
    regular = np.arange(np.ceil(first * SAMPLES_PER_SECOND), last * SAMPLES_PER_SECOND) / SAMPLES_PER_SECOND
    spans = presence_spans(motion)
    times = np.concatenate([regular, motion.times, recorded, [default_time], np.ravel(spans)])
    seconds = np.unique(np.round(times, 6))
    near = [(low - _MICROSECOND < seconds) & (seconds < high + _MICROSECOND) for low, high in spans]
    seconds = seconds[np.any(near, axis=0)]
    return SampledMotion(seconds, motion.poses(seconds), spans, default_time)


def presence_spans(motion: Motion) -> tuple[tuple[float, float], ...]:
    """The disjoint intervals (seconds) in which the object is present, in order."""
    spans: list[tuple[float, float]] = []
    for first, last in motion.runs:
        begin, end = float(motion.times[first] - motion.reach), float(motion.times[last] + motion.reach)
        if spans and begin <= spans[-1][1]:
            begin = spans.pop()[0]
        spans.append((begin, end))
    return tuple(spans)
