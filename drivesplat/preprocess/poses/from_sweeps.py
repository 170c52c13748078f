"""Poses corrected by LiDAR, and LiDAR as the judge of corrections.

Sweeps are registered to each other from the given poses. All poses are found at once, by Gauss-Newton iterations on
distances of points to planes (Chen, Medioni: Object modelling by registration of multiple range images, 1992) between
pairs of sweeps, with the given poses and the motion between them as priors. Where the surfaces leave a direction open,
as along a tunnel, the priors decide. Pairs of sweeps that had no part in it then judge: by the distances between their
surfaces, before and after. Later corrections, by images, face the same judge.
"""

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from scipy.sparse import bsr_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.corrections import Corrections, apply_corrections, magnitudes
from drivesplat.preprocess.poses.refinement_record import finite
from drivesplat.preprocess.poses.surfaces import Surfaces, surfaces_of
from drivesplat.scene.rigid import apply, cross_matrix, inverse, path_lengths, rigid
from drivesplat.scene.scene import Scene, Sweep
from drivesplat.settings.refine_poses import PriorSettings, RefinePosesJob

log = logging.getLogger(__name__)
MAX_SWEEPS = 250
"""Sweeps of a drive that are registered; of more, evenly spread ones."""
MIN_SWEEPS = 3
"""Sweeps of which a pair can be withheld."""
MIN_POINTS = 200
"""Points on surfaces without which a sweep has no part."""
MAX_PAIRS = 60
"""Withheld pairs that judge; of more, evenly spread ones."""
JUDGED_WITHIN = 1.0
"""Metres within which points of two sweeps are compared."""
Pair = tuple[int, int]
"""The numbers of two sweeps, the earlier first."""
FITTED_M = (1.0, 2.0, 5.0, 10.0, 20.0)
"""Metres that the vehicle has gone between the sweeps of a pair; the next sweep is always one."""
WITHHELD_M = (3.0, 7.0, 14.0)
"""The same of pairs that judge a registration and have no part in it."""
REACH_M = (1.0, 1.0, 1.0, 0.7, 0.5, 0.35, 0.25, 0.2, 0.15, 0.15, 0.15, 0.15)
"""Per iteration, the distance in metres within which points of two sweeps may be of one surface."""
ROBUST_SHARE = 0.25
"""Scale of the Cauchy loss of distances, relative to the reach."""
NOISE_M, EFFECTIVE = 0.03, 200
"""Standard deviation of a distance in metres, and the number of independent distances that a pair has at most: errors
of neighbouring returns are alike."""
SAMPLED = 3000
"""Number of points of a sweep that are looked for in the other one."""
MIN_SECONDS = 1e-3
"""Minimum interval between sweeps for the prior of the motion."""


@dataclass(frozen=True)
class SweepJudge:
    """Withheld `pairs` of sweeps, by their indices in `Scene.sweeps`, and the surfaces of these sweeps."""

    surfaces: dict[int, Surfaces]
    pairs: list[Pair]
    name: ClassVar[str] = "lidar_m"

    def distance(self, scene: Scene) -> float:
        """The median distance in metres between surfaces that two sweeps of a pair see: the mean of that of upright
        surfaces and that of all others. It does not change if the whole drive is moved."""
        upright, others = [], []
        for i, j in self.pairs:
            poses = [scene.sweeps[k].sensor_to_world for k in (i, j)]
            first, second = (self.surfaces[k].split(pose) for k, pose in zip((i, j), poses, strict=True))
            for found, a, b in zip((upright, others), first, second, strict=True):
                if len(a) and len(b):
                    found.append(plane_distances(a, b, inverse(poses[1]) @ poses[0], JUDGED_WITHIN))
        medians = [np.median(np.concatenate(found)) for found in (upright, others) if any(map(len, found))]
        return float(np.mean(medians)) if medians else np.inf

    def objection(self, before: float, after: float) -> str | None:
        """What speaks against refined poses, by their distance and that of the given ones; None if it is not larger."""
        if after <= before:
            return None
        return (
            f"with them the surfaces of LiDAR sweeps lie {100 * after:.2f} cm apart, with the given ones "
            f"{100 * before:.2f} cm"
        )


@dataclass(frozen=True)
class Alignment:
    """`scene`, with registered sweeps where these are better; `record`, the entry `lidar` of poses.json; the judge."""

    scene: Scene
    record: dict[str, Any] | None
    judge: SweepJudge | None


def align_sweeps(scene: Scene, job: RefinePosesJob, threads: int = 1) -> Alignment:
    """Registers the sweeps of the LiDAR that has most of them. Where there are too few readable sweeps for a withheld
    pair, returns the scene as it is, without a judge."""
    surfaces = _surfaces(scene, job, threads)
    chosen = sorted(surfaces)
    if len(chosen) < MIN_SWEEPS:
        return Alignment(scene, None, None)
    sweeps = [scene.sweeps[i] for i in chosen]
    times = np.array([sweep.timestamp for sweep in sweeps])
    vehicle = _vehicle_poses(scene, sweeps)
    pairs = [(chosen[i], chosen[j]) for i, j in pairs_of(vehicle)[1]]
    kept = np.unique(np.linspace(0, len(pairs) - 1, MAX_PAIRS).astype(int))
    judge = SweepJudge(surfaces, [pairs[i] for i in kept])
    log.info("scene %s: %d sweeps are registered", scene.name, len(sweeps))
    in_vehicle = [
        surfaces[i].moved(inverse(pose) @ sweep.sensor_to_world)
        for i, pose, sweep in zip(chosen, vehicle, sweeps, strict=True)
    ]
    refined = register(in_vehicle, vehicle, times * 1e-6, job.refine_poses.priors, threads)
    aligned = apply_corrections(scene, Corrections.from_poses(times, vehicle, refined))
    before, after = judge.distance(scene), judge.distance(aligned)
    taken = after < (1.0 - job.refine_poses.limits.min_gain) * before
    log.info(
        "scene %s: surfaces of %d withheld pairs of sweeps lie %.1f cm apart with given poses, %.1f cm with registered "
        "ones: %s",
        scene.name, len(judge.pairs), 100 * before, 100 * after,
        "these are taken" if taken else "the given ones stay",
    )  # fmt: skip
    record = {
        "sweeps": len(sweeps),
        "pairs": len(judge.pairs),
        "before_m": finite(before),
        "after_m": finite(after),
        "taken": taken,
        **magnitudes(inverse(vehicle) @ refined),
    }
    return Alignment(aligned if taken else scene, record, judge)


def _surfaces(scene: Scene, job: RefinePosesJob, threads: int) -> dict[int, Surfaces]:
    """The surfaces of the sweeps of one LiDAR that see enough of them, by their indices in `Scene.sweeps`."""
    names = [sweep.lidar for sweep in scene.sweeps]
    if not names:
        return {}
    lidar = max(dict.fromkeys(names), key=names.count)
    own = [i for i, name in enumerate(names) if name == lidar]
    chosen = [own[i] for i in np.unique(np.linspace(0, len(own) - 1, MAX_SWEEPS).astype(int))]
    with ThreadPoolExecutor(threads) as pool:
        found = pool.map(lambda i: surfaces_of(scene, scene.sweeps[i], job.lidar.own_car_radius), chosen)
        return {i: surfaces for i, surfaces in zip(chosen, found, strict=True) if len(surfaces) >= MIN_POINTS}


def _vehicle_poses(scene: Scene, sweeps: list[Sweep]) -> np.ndarray:
    """The vehicle's poses (n, 4, 4) at the times of sweeps, by the mount of the LiDAR at the sweep nearest to an image.
    Without images, the poses of the LiDAR."""
    if not scene.frames:
        return np.stack([sweep.sensor_to_world for sweep in sweeps])
    times = np.array([frame.timestamp for frame in scene.frames])
    poses = np.stack([frame.ego_to_world for frame in scene.frames])
    between = np.abs(times[:, None] - np.array([sweep.timestamp for sweep in sweeps]))
    frame, sweep = np.unravel_index(np.argmin(between), between.shape)
    sensor_to_vehicle = inverse(poses[frame]) @ sweeps[sweep].sensor_to_world
    return np.stack([sweep.sensor_to_world @ inverse(sensor_to_vehicle) for sweep in sweeps])


def pairs_of(poses: np.ndarray) -> tuple[list[Pair], list[Pair]]:
    """The pairs of sweeps at `poses` (n, 4, 4) that a registration fits, and those that it leaves out. Of few
    sweeps these are the first and the last; two sweeps alone leave none out."""
    fitted = _pairs_at(poses, FITTED_M) | {(i, i + 1) for i in range(len(poses) - 1)}
    withheld = _pairs_at(poses, WITHHELD_M) - fitted
    if not withheld and len(poses) > 2:
        withheld = {(0, len(poses) - 1)}
    return sorted(fitted - withheld), sorted(withheld)


def _pairs_at(poses: np.ndarray, distances: Sequence[float]) -> set[Pair]:
    """From each sweep to the first ones at `distances` (metres along the path)."""
    gone = path_lengths(poses)
    ends = (np.searchsorted(gone, gone + distance) for distance in distances)
    return {(i, int(j)) for to in ends for i, j in enumerate(to) if j < len(poses)}


def plane_distances(first: Surfaces, second: Surfaces, first_to_second: np.ndarray, reach: float) -> np.ndarray:
    """The distances (k,) in metres of the points of a sweep to the surfaces of another that lie within `reach`."""
    points = apply(first_to_second, first.points)
    distances, near = second.tree.query(points, distance_upper_bound=reach)
    hit = np.isfinite(distances)
    return np.abs(np.einsum("ni,ni->n", points[hit] - second.points[near[hit]], second.normals[near[hit]]))


def register(
    surfaces: Sequence[Surfaces], given: np.ndarray, seconds: np.ndarray, priors: PriorSettings, threads: int = 1
) -> np.ndarray:
    """Poses (n, 4, 4), frame of the surfaces to world, that bring `surfaces` together. The `given` ones, at `seconds`
    (n,), are priors; their frames have x forward and z up."""
    poses, (pairs, _) = given.copy(), pairs_of(given)
    sampled = [surface.sampled(SAMPLED) for surface in surfaces]
    with ThreadPoolExecutor(threads) as pool:
        for reach in REACH_M:
            system = _System(len(poses))
            term = partial(_pair_term, sampled, surfaces, poses, reach)
            for (i, j), (matrix, vector) in zip(pairs, pool.map(term, pairs), strict=True):
                system.add((i, j), matrix, vector)
            _add_priors(system, poses, given, seconds, priors)
            poses = poses @ _exponential(system.step())
    return poses


def _pair_term(
    sampled: Sequence[Surfaces], surfaces: Sequence[Surfaces], poses: np.ndarray, reach: float, pair: Pair
) -> tuple[np.ndarray, np.ndarray]:
    """The normal equations (12, 12), (12,) of one pair, for steps of both poses in their own frames."""
    i, j = pair
    relative = inverse(poses[j]) @ poses[i]
    points = apply(relative, sampled[i].points)
    distances, near = surfaces[j].tree.query(points, distance_upper_bound=reach)
    hit = np.flatnonzero(np.isfinite(distances))
    if not len(hit):
        return np.zeros((12, 12)), np.zeros(12)
    own, other, normals = sampled[i].points[hit], points[hit], surfaces[j].normals[near[hit]]
    alike = np.abs(np.einsum("ni,ni->n", sampled[i].normals[hit] @ relative[:3, :3].T, normals)) > 0.8
    own, other, normals, near = own[alike], other[alike], normals[alike], near[hit][alike]
    residuals = np.einsum("ni,ni->n", other - surfaces[j].points[near], normals)
    scale = ROBUST_SHARE * reach
    weights = 1.0 / (1.0 + (residuals / scale) ** 2) / NOISE_M**2 * min(1.0, EFFECTIVE / max(1, len(own)))
    in_own = normals @ relative[:3, :3]
    jacobian = np.hstack([in_own, np.cross(own, in_own), -normals, -np.cross(other, normals)])
    weighted = jacobian * weights[:, None]
    return weighted.T @ jacobian, weighted.T @ residuals


def _add_priors(
    system: "_System", poses: np.ndarray, given: np.ndarray, seconds: np.ndarray, priors: PriorSettings
) -> None:
    """The priors of poses and of the motion between successive ones, with a Cauchy loss: recorded poses may jump."""
    sigmas = np.array([priors.position, priors.position, priors.height, priors.tilt, priors.tilt, priors.heading])
    for i, error in enumerate(_logarithm(inverse(given) @ poses)):
        weights = 1.0 / (sigmas**2 + error**2)
        system.add((i,), np.diag(weights), weights * error)
    moved = inverse(poses[:-1]) @ poses[1:]
    errors = _logarithm(inverse(inverse(given[:-1]) @ given[1:]) @ moved)
    for i, (error, relative) in enumerate(zip(errors, moved, strict=True)):
        interval = max(MIN_SECONDS, float(seconds[i + 1] - seconds[i]))
        weights = 1.0 / ((priors.drift * sigmas) ** 2 * interval + error**2)
        jacobian = np.hstack([-_adjoint(inverse(relative)), np.eye(6)])
        weighted = jacobian.T * weights
        system.add((i, i + 1), weighted @ jacobian, weighted @ error)


class _System:
    """Normal equations of steps (n, 6) of poses: translation and rotation vector, in the frame of each pose."""

    def __init__(self, count: int) -> None:
        self._blocks: dict[Pair, np.ndarray] = {(i, i): np.zeros((6, 6)) for i in range(count)}
        self._vector = np.zeros((count, 6))

    def add(self, poses: tuple[int, ...], matrix: np.ndarray, vector: np.ndarray) -> None:
        """Adds the terms of some poses: matrix (6 k, 6 k), vector (6 k,)."""
        for a, i in enumerate(poses):
            self._vector[i] += vector[6 * a : 6 * a + 6]
            for b, j in enumerate(poses):
                block = self._blocks.setdefault((i, j), np.zeros((6, 6)))
                block += matrix[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]

    def step(self) -> np.ndarray:
        """The steps (n, 6) that minimise the linearised sum."""
        order = sorted(self._blocks)
        rows = np.searchsorted([i for i, _ in order], np.arange(len(self._vector) + 1))
        blocks = np.stack([self._blocks[key] for key in order])
        size = self._vector.size
        matrix = bsr_array((blocks, np.array([j for _, j in order]), rows), shape=(size, size))
        return -spsolve(matrix.tocsc(), self._vector.ravel()).reshape(-1, 6)


def _exponential(steps: np.ndarray) -> np.ndarray:
    """Transforms (n, 4, 4) of steps (n, 6); first order in the translation's coupling to the rotation."""
    return rigid(Rotation.from_rotvec(steps[:, 3:]).as_matrix(), steps[:, :3])


def _logarithm(transforms: np.ndarray) -> np.ndarray:
    """Translations and rotation vectors (n, 6) of transforms (n, 4, 4)."""
    turns = Rotation.from_matrix(transforms[:, :3, :3]).as_rotvec()
    return np.hstack([transforms[:, :3, 3], turns])


def _adjoint(transform: np.ndarray) -> np.ndarray:
    """The matrix (6, 6) that takes a small step in one frame to the frame that `transform` (4, 4) leads to."""
    rotation = transform[:3, :3]
    return np.block([[rotation, cross_matrix(transform[:3, 3]) @ rotation], [np.zeros((3, 3)), rotation]])
