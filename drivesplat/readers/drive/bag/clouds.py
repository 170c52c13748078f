"""Point clouds of ROS as sweeps of drive folders, by the names, types and offsets of their fields."""

from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.bag.bag_file import header_stamp, listed
from drivesplat.readers.drive.bag.bag_map import BagLidar, PointTime
from drivesplat.readers.drive.poses import reach_us
from drivesplat.readers.drive.sweep_file import MAX_RINGS
from drivesplat.readers.sweep_motion import TOLERANCE_S

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's types of a PointField's datatypes."""
NANOSECONDS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
MAX_OFFSET_S = 1.0
"""Seconds from the stamp within which all points of a sweep are measured."""
SHARE_BEFORE_STAMP = {"start": 0.0, "middle": 0.5, "end": 1.0}
"""The part of a revolution before the stamp."""


def point_rows(cloud: Any) -> np.ndarray:
    """The points (n,) of a PointCloud2 as rows with its fields. Raises DatasetError, the end of a sentence, where they
    do not fit its bytes."""
    names = [str(one.name) for one in cloud.fields]
    known = [one for one in cloud.fields if one.datatype in TYPES and one.name]
    step, row_step, width, height = (int(getattr(cloud, it)) for it in ("point_step", "row_step", "width", "height"))
    lacking = [name for name in "xyz" if name not in names]
    if lacking:
        raise DatasetError(f"has no field {', '.join(lacking)}; its fields are {listed(names)}")
    order = ">" if cloud.is_bigendian else "<"
    types = [np.dtype(f"{order}{TYPES[one.datatype]}") for one in known]
    if len(set(names)) < len(names) or any(
        one.offset + kind.itemsize > step for one, kind in zip(known, types, strict=True)
    ):
        raise DatasetError(f"has fields that do not fit its point_step of {step} bytes: {listed(names)}")
    count, data = width * height, cloud.data
    row_step = row_step if height > 1 else width * step
    if count and (row_step < width * step or len(data) < row_step * (height - 1) + width * step):
        raise DatasetError(f"has {len(data)} bytes, too few for {count} points of {step} bytes")
    layout = {
        "names": [one.name for one in known], "formats": types, "offsets": [one.offset for one in known],
        "itemsize": step,
    }  # fmt: skip
    if not count:
        return np.zeros(0, dtype=np.dtype(layout))
    return np.ndarray((height, width), np.dtype(layout), data.data, 0, (row_step, step)).reshape(-1)


def sweep_columns(cloud: Any, lidar: BagLidar) -> dict[str, np.ndarray]:
    """The columns of a sweep: x, y, z in metres in the LiDAR's frame and, where the map names them, intensity (0 to 1),
    ring, and time in seconds after the stamp. Points that are not finite or at the sensor itself are left out, and
    points with the time 0 where times count from 1970.

    Raises DatasetError, the end of a sentence, where the cloud does not fit the map, or has no points.
    """
    rows = point_rows(cloud)
    named = [name for name in (lidar.intensity, lidar.ring, lidar.time and lidar.time.field) if name]
    lacking = [name for name in named if name not in (rows.dtype.names or ())]
    if lacking:
        raise DatasetError(f"has no field {', '.join(lacking)}; its fields are {listed(rows.dtype.names)}")
    points = np.stack([rows[name] for name in "xyz"], axis=1).astype(np.float32)
    measured = np.isfinite(points).all(axis=1) & points.any(axis=1)
    if lidar.time and lidar.time.counts_from == "epoch":
        measured &= rows[lidar.time.field] != 0
    rows, points = rows[measured], points[measured]
    if not len(points):
        raise DatasetError("has no points")
    columns = dict(zip("xyz", np.ascontiguousarray(points.T), strict=True))
    if lidar.intensity:
        scaled = rows[lidar.intensity].astype(np.float32) / np.float32(lidar.intensity_scale)
        columns["intensity"] = np.nan_to_num(scaled, posinf=1.0).clip(0.0, 1.0)
    if lidar.ring:
        ring = rows[lidar.ring].astype(np.float64)
        if not ((ring >= 0) & (ring < MAX_RINGS)).all():
            raise DatasetError(f"has rings from {np.nanmin(ring):g} to {np.nanmax(ring):g} in {lidar.ring}")
        columns["ring"] = ring.astype(np.uint16)
    if lidar.time:
        columns["time"] = _seconds(rows[lidar.time.field], lidar, lidar.time, header_stamp(cloud)).astype(np.float32)
    return columns


def _seconds(values: np.ndarray, lidar: BagLidar, time: PointTime, stamp: int) -> np.ndarray:
    """The times of points in seconds after the stamp (nanoseconds)."""
    unit = NANOSECONDS[time.unit]
    if time.counts_from == "epoch":  # integers stay exact
        exact = values.astype(np.int64) if values.dtype.kind in "iu" else values.astype(np.float64)
        seconds = (exact - (stamp // int(unit) if exact.dtype.kind == "i" else stamp / unit)) * (unit * 1e-9)
    else:
        seconds = values.astype(np.float64) * (unit * 1e-9)
    if time.counts_from == "start":
        seconds = seconds - seconds.min() - SHARE_BEFORE_STAMP[lidar.stamp] * (lidar.revolution_s or 0.0)
    longest = MAX_OFFSET_S
    if not lidar.motion_compensated:  # as drive folders are read
        longest = reach_us(lidar.revolution_s) * 1e-6 + TOLERANCE_S
    if not (np.abs(seconds) <= longest).all():
        raise DatasetError(
            f"has points {np.nanmin(seconds):.3g} to {np.nanmax(seconds):.3g} s after its stamp by the field "
            f"{time.field}: check its unit, what it counts from, and revolution_s in the map"
        )
    return seconds
