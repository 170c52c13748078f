"""Poses corrected by LiDAR, and LiDAR as the judge of corrections.

Sweeps are registered to each other from the given poses. Pairs of sweeps that had no part in it then judge: by the
distances between their surfaces, before and after. Later corrections, by images, face the same judge.
"""

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from drivesplat.preprocess.poses.corrections import Corrections, apply_corrections, magnitudes
from drivesplat.preprocess.poses.refinement_record import finite
from drivesplat.preprocess.poses.registration import Pair, pairs_of, plane_distances, register
from drivesplat.preprocess.poses.surfaces import Surfaces, surfaces_of
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Scene, Sweep
from drivesplat.settings.refine_poses import RefinePosesJob

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
