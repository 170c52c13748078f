"""Poses over time: linear position and slerp between those that are known."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation, Slerp

from drivesplat.scene.rigid import rigid


@dataclass(frozen=True, eq=False)
class PosePath:
    """`poses` at increasing `times` (n,) in any unit, at least one.

    >>> PosePath(np.array([0, 10]), np.stack([np.eye(4), np.eye(4)])).at(np.array([5])).shape
    (1, 4, 4)
    """

    times: np.ndarray
    poses: Float64[np.ndarray, "n 4 4"]

    def at(self, times: np.ndarray) -> Float64[np.ndarray, "m 4 4"]:
        """The poses at `times` (m,); outside the known times the nearest."""
        if len(self.times) == 1:
            return np.repeat(self.poses, len(times), axis=0)
        within = np.clip(times, self.times[0], self.times[-1]).astype(np.float64)
        places = np.stack([np.interp(within, self.times, self.poses[:, axis, 3]) for axis in range(3)], axis=-1)
        return rigid(self._rotations(within).as_matrix(), places)

    @cached_property
    def _rotations(self) -> Slerp:
        return Slerp(self.times.astype(np.float64), Rotation.from_matrix(self.poses[:, :3, :3]))
