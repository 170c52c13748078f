"""A motion as other programs play it: poses at times so close that what they do in between does no harm.

Thirty times a second, at the annotations and at recorded images. Programs interpolate matrices entry by entry: between
two samples that leaves a point of a vehicle within a millimetre or so of where it belongs.
"""

from dataclasses import dataclass

import numpy as np

from drivesplat.scene.motion import Motion

SAMPLES_PER_SECOND = 30
_MICROSECOND = 1e-6


@dataclass(frozen=True)
class SampledMotion:
    """Where an object is at `seconds` (n,), whole microseconds since the first image: `object_to_world` (n, 4, 4).

    It is there during `spans` only, each from its first to its last second; there are no samples beyond. `still` is the
    second at which programs see it that know no time.
    """

    seconds: np.ndarray
    object_to_world: np.ndarray
    spans: tuple[tuple[float, float], ...]
    still: float

    @property
    def still_pose(self) -> np.ndarray:
        """The pose (4, 4) at `still`; where the object is absent then, the one nearest to it in time."""
        return self.object_to_world[np.abs(self.seconds - self.still).argmin()]

    @property
    def present_when_still(self) -> bool:
        return any(first <= self.still <= last for first, last in self.spans)


def sampled(motion: Motion, recorded: np.ndarray, still: float) -> SampledMotion:
    """The motion at all times worth a sample, the seconds `recorded` (m,) and `still` among them while it is there."""
    first, last = motion.span
    regular = np.arange(np.ceil(first * SAMPLES_PER_SECOND), last * SAMPLES_PER_SECOND) / SAMPLES_PER_SECOND
    spans = presence(motion)
    wanted = np.concatenate([regular, motion.times, recorded, [still], np.ravel(spans)])
    seconds = np.unique(np.round(wanted, 6))
    near = [(low - _MICROSECOND < seconds) & (seconds < high + _MICROSECOND) for low, high in spans]
    seconds = seconds[np.any(near, axis=0)]
    return SampledMotion(seconds, motion.poses(seconds), spans, still)


def presence(motion: Motion) -> tuple[tuple[float, float], ...]:
    """From when to when (seconds) the object is there: apart from each other, in order."""
    spans: list[tuple[float, float]] = []
    for first, last in motion.runs:
        begin, end = float(motion.times[first] - motion.reach), float(motion.times[last] + motion.reach)
        if spans and begin <= spans[-1][1]:
            begin = spans.pop()[0]
        spans.append((begin, end))
    return tuple(spans)
