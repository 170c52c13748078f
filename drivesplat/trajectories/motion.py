"""The smooth motion of an annotated object: its pose at any time, by splines through the annotations.

Seconds count from the scene's first image. Frames as in `drivesplat.scene.scene`: object x forward, y left, z up, at
the box centre; world metres.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import runs

PATH_STEP = 0.05
"""Seconds between the positions that give the length of a path."""
HALF_STEP = 0.02
"""Half the time in seconds between the two poses that give the velocity of a moving object; some readout times of a
camera."""


@dataclass(frozen=True)
class Motion:
    """A motion through the poses `object_to_world` (k, 4, 4) at increasing `times` (k,) in seconds.

    Within each of `runs` (first and last index of consecutive annotations) position and rotation are twice continuously
    differentiable; up to `reach` seconds beyond a run's ends the object continues at constant velocity; elsewhere it
    is absent. `turns` (k,) are corrections of the heading: radians about the object's vertical axis, interpolated
    like positions.
    """

    times: Float[np.ndarray, " k"]
    object_to_world: Float[np.ndarray, "k 4 4"]
    runs: tuple[tuple[int, int], ...]
    reach: float
    turns: Float[np.ndarray, " k"] | None = None

    def fault(self) -> str | None:
        """What no motion has, None without a fault."""
        if not len(self.times) or (np.diff(self.times) <= 0.0).any():
            return "times do not increase"
        ends = np.array(self.runs).reshape(-1)
        sound = len(ends) and ends[0] == 0 and ends[-1] == len(self.times) - 1 and (np.diff(ends) >= 0).all()
        return None if sound else "runs do not cover the annotations"

    @classmethod
    def of_track(cls, scene: Scene, track: Track) -> "Motion":
        """The motion through a track's annotations; its reach is half a key-frame interval."""
        times = np.array([scene.seconds(timestamp) for timestamp in track.timestamps])
        reach = scene.key_frame_interval * 0.5e-6
        return cls(times, track.object_to_world, tuple(runs(track.sample_indices)), reach)

    @property
    def span(self) -> tuple[float, float]:
        """The first and the last second at which the object is present."""
        return float(self.times[0] - self.reach), float(self.times[-1] + self.reach)

    def present(self, at: np.ndarray) -> np.ndarray:
        """Whether the object is present at the seconds `at` (n,): (n,) bool."""
        spans = (self.times[[first, last]] + [-self.reach, self.reach] for first, last in self.runs)
        return np.any([(low <= at) & (at <= high) for low, high in spans], axis=0)

    def poses(self, at: np.ndarray) -> np.ndarray:
        """The poses (n, 4, 4) at the seconds `at` (n,); while the object is absent, poses of the nearest run."""
        at = np.asarray(at, dtype=np.float64)
        poses, weights = np.tile(np.eye(4), (len(at), 1, 1)), self.weights(at)
        poses[:, :3, 3] = weights @ self.object_to_world[:, :3, 3]
        for (first, last), chosen in self._chosen(at):
            if first == last:
                poses[chosen, :3, :3] = self.object_to_world[first, :3, :3]
                continue
            spline, within = self._turns[first, last], at[chosen].clip(self.times[first], self.times[last])
            turning = spline(within, order=1) * (at[chosen] - within)[:, None]  # constant beyond the ends
            poses[chosen, :3, :3] = (spline(within) * Rotation.from_rotvec(turning)).as_matrix()
        if self.turns is not None:
            about_vertical = Rotation.from_rotvec((weights @ self.turns)[:, None] * [0.0, 0.0, 1.0])
            poses[:, :3, :3] = poses[:, :3, :3] @ about_vertical.as_matrix()
        return poses

    def walked(self, at: np.ndarray) -> np.ndarray:
        """The length (n,) in metres of the horizontal path from the first annotation to the seconds `at` (n,); negative
        before it. A gap of the annotations is a straight line, and beyond the ends the path does not go on."""
        times, lengths = self._path
        return np.interp(at, times, lengths)

    @cached_property
    def _path(self) -> tuple[np.ndarray, np.ndarray]:
        """Seconds (s,), and the length of the path from the first annotation to each."""
        spans = [np.clip(self.times[[a, b]] + [-self.reach, self.reach], *self.span) for a, b in self.runs]
        times = np.concatenate([np.linspace(a, b, max(2, int((b - a) / PATH_STEP) + 1)) for a, b in spans])
        times = np.unique(np.concatenate([times, self.times[:1]]))
        steps = np.linalg.norm(np.diff(self.poses(times)[:, :2, 3], axis=0), axis=1)
        lengths = np.concatenate([[0.0], np.cumsum(steps)])
        return times, lengths - lengths[np.searchsorted(times, self.times[0])]

    def weights(self, at: np.ndarray) -> np.ndarray:
        """The annotations' weights (n, k) in the position at the seconds `at` (n,): position = weights @ positions.

        A natural cubic spline is linear in its control values: other values at the annotations, such as a learned
        correction, are interpolated by the same weights.
        """
        at = np.asarray(at, dtype=np.float64)
        weights = np.zeros((len(at), len(self.times)))
        for (first, last), chosen in self._chosen(at):
            if first == last:
                weights[chosen, first] = 1.0
                continue
            spline, within = self._bases[first, last], at[chosen].clip(self.times[first], self.times[last])
            beyond = (at[chosen] - within)[:, None] * spline(within, 1)  # linear there
            weights[chosen, first : last + 1] = spline(within) + beyond
        return weights

    def _chosen(self, at: np.ndarray) -> list[tuple[tuple[int, int], np.ndarray]]:
        """For each run the indices (m,) of the entries of `at` that are nearest to it."""
        ends = self.times[np.array(self.runs)]
        outside = np.maximum(ends[:, :1] - at, at - ends[:, 1:])
        nearest = outside.argmin(axis=0)
        return [(run, np.flatnonzero(nearest == i)) for i, run in enumerate(self.runs)]

    @cached_property
    def _turns(self) -> dict[tuple[int, int], RotationSpline]:
        return {
            (first, last): RotationSpline(
                self.times[first : last + 1], Rotation.from_matrix(self.object_to_world[first : last + 1, :3, :3])
            )
            for first, last in self.runs
            if first < last
        }

    @cached_property
    def _bases(self) -> dict[tuple[int, int], CubicSpline]:
        """Per run the cardinal splines: 1 at one annotation and 0 at the others."""
        lengths = {(first, last): last + 1 - first for first, last in self.runs if first < last}
        return {
            (first, last): CubicSpline(self.times[first : last + 1], np.eye(length), bc_type="natural")
            for (first, last), length in lengths.items()
        }
