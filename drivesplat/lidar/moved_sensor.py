"""The pose of a LiDAR during a recorded scan, and the same rays from a sensor that moves in another way."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial.transform import Rotation

from drivesplat.lidar.scans import SensorPoses, mean_velocity
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scan_record import RecordedScan


def steady_motion(pose: Float64[np.ndarray, "4 4"], linear: np.ndarray, angular: np.ndarray) -> SensorPoses:
    """Poses (n, 4, 4) at offsets (n,) in seconds from a pose, at constant velocities (3,) along its axes, m/s and
    rad/s."""

    def at(offsets: np.ndarray) -> np.ndarray:
        turns = Rotation.from_rotvec(offsets[:, None] * angular).as_matrix()
        return pose @ rigid(turns, offsets[:, None] * linear)

    return at


def sensor_poses_of(recorded: RecordedScan) -> SensorPoses:
    """Sensor to world (n, 4, 4) at offsets (n,) in seconds from a scan's timestamp, by its velocities."""
    return steady_motion(recorded.sensor_to_world, recorded.linear, recorded.angular)


def places_of_returns(
    sensor: RecordedScan, ranges: Float[np.ndarray, "b a"], returned: Bool[np.ndarray, "b a"]
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """The returns at `ranges` in metres along the rays of a scan in world coordinates, beam by beam, and the sensor's
    positions at their times, metres."""
    poses = sensor_poses_of(sensor)(sensor.scan.rays.offsets_s[returned].astype(np.float64))
    seen = (sensor.scan.rays.directions() * ranges[..., None])[returned].astype(np.float64)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], seen) + poses[:, :3, 3], poses[:, :3, 3]


def moved(recorded: RecordedScan, sensor: SensorPoses) -> RecordedScan:
    """The rays of a recorded scan from a sensor whose poses (n, 4, 4) in the world `sensor` gives at offsets (n,). What
    the scan returned, and the objects that it met, stay those recorded."""
    ends = recorded.scan.rays.offsets_s
    first, last = float(ends.min()), float(ends.max())
    pose = sensor(np.zeros(1))[0]
    linear, angular = mean_velocity(lambda offsets: inverse(pose) @ sensor(offsets), first, last)
    return replace(recorded, sensor_to_world=pose, linear=linear, angular=angular)
