"""A few sweeps of a drive in the world, by which the checks compare its poses, boxes and images."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from drivesplat.readers.sweeps import sound_returns
from drivesplat.scene.rigid import apply, interpolate, inverse
from drivesplat.scene.scene import Scene, Sweep

PAIRS = 6
"""Pairs of sweeps of each LiDAR, from its first sweep to its last."""
PAIR_US = 400_000
"""Minimum time in microseconds between the sweeps of a pair."""


class SampledSweep(NamedTuple):
    """The returns of a sweep. `points` in the world, at `offsets_s` seconds after the sweep's timestamp (0 where
    unknown)."""

    sweep: Sweep
    points: Float64[np.ndarray, "n 3"]
    offsets_s: Float64[np.ndarray, " n"]


def pairs_of_sweeps(scene: Scene, sweeps: Iterable[Sweep]) -> list[Sweep]:
    """Of these sweeps PAIRS pairs of each LiDAR of a scene, in the order of time."""
    chosen, found = list(sweeps), []
    for lidar in scene.lidars:
        own = sorted((s for s in chosen if s.lidar == lidar.name), key=lambda sweep: sweep.timestamp)
        times = np.array([sweep.timestamp for sweep in own])
        firsts = np.linspace(0, len(own) - 1, PAIRS).round().astype(int) if own else np.zeros(0, dtype=int)
        seconds = np.minimum(np.searchsorted(times, times[firsts] + PAIR_US), len(own) - 1) if own else firsts
        found += [own[i] for i in np.union1d(firsts, seconds)]
    return found


def sampled_sweeps(scene: Scene) -> list[SampledSweep]:
    """Pairs of sweeps, as `pairs_of_sweeps` chooses them, of those with a sound file."""
    found = []
    for sweep in pairs_of_sweeps(scene, (sweep for sweep in scene.sweeps if Path(sweep.path).is_file())):
        if (returns := sound_returns(sweep)) is not None:
            offsets = np.zeros(len(returns.points)) if returns.offsets_s is None else returns.offsets_s
            found.append(SampledSweep(sweep, apply(sweep.sensor_to_world, returns.points), offsets))
    return found


def ego_pose(scene: Scene, sweep: Sweep) -> np.ndarray:
    """Ego to world (4, 4) at a sweep's time: by the mount of the LiDAR where it is known, otherwise between the images
    before and after; the LiDAR's own pose where there are no images."""
    if sweep.motion is not None:
        return sweep.sensor_to_world @ inverse(sweep.motion.sensor_to_ego)
    frames = sorted(scene.frames, key=lambda frame: frame.timestamp)
    if not frames:
        return sweep.sensor_to_world
    times = [frame.timestamp for frame in frames]
    after = int(np.searchsorted(times, sweep.timestamp))
    if after in (0, len(frames)) or times[after] == sweep.timestamp:
        return frames[min(after, len(frames) - 1)].ego_to_world
    share = (sweep.timestamp - times[after - 1]) / (times[after] - times[after - 1])
    return interpolate(frames[after - 1].ego_to_world, frames[after].ego_to_world, share)
