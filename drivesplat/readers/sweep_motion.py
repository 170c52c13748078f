"""Motion compensation of LiDAR sweeps: points as they would have been seen at the sweep's timestamp."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from drivesplat.scene.sensors import LidarReturns, SweepMotion

TOLERANCE_S = 1e-3
"""Seconds by which points may lie beyond the known motion; they take its nearest pose."""


def motion_fault(returns: LidarReturns, motion: SweepMotion) -> str | None:
    """Why the returns of a sweep's file cannot be compensated, as the end of a sentence; None if they can."""
    if returns.offsets_s is None:
        return "has no column time, which motion_compensated: false needs"
    first, last = float(returns.offsets_s.min()), float(returns.offsets_s.max())
    begin, end = float(motion.offsets_s[0]), float(motion.offsets_s[-1])
    if first < begin - TOLERANCE_S or last > end + TOLERANCE_S:
        return (
            f"has points at {first:.3g} to {last:.3g} s after its timestamp, and the vehicle's motion is known from "
            f"{begin:.3g} to {end:.3g} s: check the unit of time, ego_poses and the LiDAR's revolution_s"
        )
    return None


def compensated(returns: LidarReturns, motion: SweepMotion) -> LidarReturns:
    """Returns without a `motion_fault`, with points (n, 3) in the sensor's frame at the sweep's timestamp; they are
    given in its frame at their own times."""
    assert returns.offsets_s is not None
    in_ego = returns.points @ motion.sensor_to_ego[:3, :3].T + motion.sensor_to_ego[:3, 3]
    if len(motion.offsets_s) == 1:
        (pose,) = motion.ego_to_sweep
        return replace(returns, points=in_ego @ pose[:3, :3].T + pose[:3, 3])
    offsets = np.clip(returns.offsets_s, motion.offsets_s[0], motion.offsets_s[-1])
    turns = Slerp(motion.offsets_s, Rotation.from_matrix(motion.ego_to_sweep[:, :3, :3]))(offsets)
    places = np.stack([np.interp(offsets, motion.offsets_s, motion.ego_to_sweep[:, i, 3]) for i in range(3)], axis=1)
    return replace(returns, points=turns.apply(in_ego) + places)
