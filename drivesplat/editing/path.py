"""The way of an actor in an edited drive: which path it takes, how far it has come when, and how far beside it is.

Seconds `at` (n,) are those of the film. `edited_cast` makes ways, `drivesplat.editing.steps` changes them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.editing.heading import beside_the_way, turned
from drivesplat.editing.trajectory import Course
from drivesplat.scene.motion import Motion


@dataclass(frozen=True)
class Progress:
    """How far an actor has come: where it was recorded at seconds `clock` (n,), and `along` (n,) metres further on.

    `faithful` (n,) in [0, 1]: how much of the recording's deviation from the path it shows there; 0 where it drives at
    a speed of its own.
    """

    clock: np.ndarray
    along: np.ndarray
    faithful: np.ndarray


@dataclass(frozen=True)
class Offsets:
    """How far an actor is out of its way, each (n,): `ahead` metres along the path, `lateral` metres to the left of the
    path, at the rate `drift` in m/s, `yaw` radians to the left."""

    ahead: np.ndarray
    lateral: np.ndarray
    drift: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True)
class Way:
    """A way along `path`, whose box centres were recorded half of `height` (metres) over the ground.

    `progress`, `offsets` and `present` (n,) bool are functions of the seconds `at` (n,). It is there first at second
    `begin` and, as recorded, last at `end`. `direction`: 1 as recorded, -1 backwards. `faces`: 1 as recorded, -1 turned
    round.
    """

    course: Course
    height: float
    progress: Callable[[np.ndarray], Progress]
    offsets: Callable[[np.ndarray], Offsets]
    recorded: Callable[[np.ndarray], np.ndarray]
    begin: float
    end: float
    since: float = np.inf
    direction: int = 1
    faces: int = 1

    def metres(self, at: np.ndarray) -> np.ndarray:
        """How far along its path (n,) its progress is."""
        progress = self.progress(at)
        return self.course.metres(progress.clock) + progress.along

    def present(self, at: np.ndarray) -> np.ndarray:
        """Whether it is there (n,): whenever it was recorded, and at a pace of its own besides while it has come to the
        stretch that was recorded, and not past it; how far it is shifted along its way counts for nothing."""
        there, own = self.recorded(at), at >= self.since
        if own.any():
            low, high = self.course.stretch
            metres = self.metres(at[own])
            there[own] |= (low <= metres) & (metres <= high)
        return there

    def poses(self, at: np.ndarray, height: float) -> np.ndarray:
        """The poses (n, 4, 4) of the centre of a box `height` metres high that stands on the ground of this way."""
        offsets = self.offsets(at)
        poses = beside_the_way(self._on_the_path, at, offsets.lateral, offsets.drift)
        poses[:, :3, 3] += 0.5 * (height - self.height) * poses[:, :3, 2]
        return turned(poses, offsets.yaw)

    def _on_the_path(self, at: np.ndarray) -> np.ndarray:
        """The poses (n, 4, 4) that lie beside none."""
        progress, ahead = self.progress(at), self.offsets(at).ahead
        metres = self.course.metres(progress.clock) + progress.along + ahead
        return self.course.places(metres) @ _partly(self.course.deviation(progress.clock), progress.faithful)


def recorded_way(motion: Motion, height: float) -> Way:
    """The way as it was driven, by an object `height` metres high."""
    begin, end = motion.span
    return Way(Course(motion), height, _as_recorded, _none, motion.present, begin, end)


def _as_recorded(at: np.ndarray) -> Progress:
    return Progress(at, np.zeros(len(at)), np.ones(len(at)))


def _none(at: np.ndarray) -> Offsets:
    return Offsets(*np.zeros((4, len(at))))


def _partly(transforms: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Transforms (n, 4, 4) whose translations and turns are `share` (n,) of those of `transforms` (n, 4, 4)."""
    result = transforms.copy()
    turns = Rotation.from_matrix(transforms[:, :3, :3]).as_rotvec()
    result[:, :3, :3] = Rotation.from_rotvec(share[:, None] * turns).as_matrix()
    result[:, :3, 3] *= share[:, None]
    return result
