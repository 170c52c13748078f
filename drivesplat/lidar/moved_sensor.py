"""The pose of a LiDAR during a recorded scan, and the same rays from a sensor that moves in another way."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.lidar.scans import SensorPoses, mean_velocity
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scan_record import RecordedScan


def sensor_poses_of(recorded: RecordedScan) -> SensorPoses:
    """Sensor to world (n, 4, 4) at offsets (n,) in seconds from a scan's timestamp, by its velocities."""

    def at(offsets: np.ndarray) -> np.ndarray:
        turns = Rotation.from_rotvec(offsets[:, None] * recorded.angular).as_matrix()
        return recorded.sensor_to_world @ rigid(turns, offsets[:, None] * recorded.linear)

    return at


def moved(recorded: RecordedScan, sensor: SensorPoses) -> RecordedScan:
    """The rays of a recorded scan from a sensor whose poses (n, 4, 4) in the world `sensor` gives at offsets (n,). What
    the scan returned, and the objects that it met, stay those recorded."""
    ends = recorded.scan.rays.offsets_s
    first, last = float(ends.min()), float(ends.max())
    pose = sensor(np.zeros(1))[0]
    linear, angular = mean_velocity(lambda offsets: inverse(pose) @ sensor(offsets), first, last)
    return replace(recorded, sensor_to_world=pose, linear=linear, angular=angular)
