"""What the fields of a point cloud mean: proposals for the map, by the names that drivers use and by the values."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.readers.drive.bag.bag_file import header_stamp
from drivesplat.readers.drive.bag.clouds import MAX_OFFSET_S, NANOSECONDS, point_rows

TIMES = {
    "t": "Ouster's", "time": "Velodyne's", "timestamp": "Hesai's, RoboSense's and Livox's", "time_stamp": "Autoware's",
    "offset_time": "Livox's",
}  # fmt: skip
"""Fields with the times of points, and whose name that is."""
RINGS = ("ring", "channel", "line", "laser_id")
"""Fields with the index of the beam: Velodyne, Ouster and Hesai; Autoware; Livox; others."""
INTENSITIES = ("reflectivity", "intensity", "reflectance")
"""Fields with the intensity. Ouster's reflectivity counts to 255, its intensity is a number of photons."""
OWN = {"x": 0, "y": 4, "z": 8, "intensity": 12, "t": 16, "ring": 20}
"""The fields and offsets of clouds that `drivesplat mcap` writes, with a point_step of OWN_STEP bytes."""
OWN_STEP = 24
MIN_SPAN_S, MAX_SPAN_S = 1e-3, 1.0
"""Seconds that the times of a sweep's points span: in one unit only, since units differ by factors of 1000."""


@dataclass(frozen=True)
class CloudLayout:
    """What a map says of a LiDAR's fields: values as YAML, and reasons. `span_s`: seconds between the first and the
    last point, 0 where times are not known."""

    time: str
    time_reason: str
    span_s: float
    compensated: bool
    compensated_reason: str
    ring: str
    ring_reason: str
    intensity: str
    scale: float
    scale_reason: str


def cloud_layout(cloud: Any) -> CloudLayout:
    """The proposal for a cloud like this one. Raises DatasetError, the end of a sentence, for one that has no x, y, z
    or is damaged."""
    rows = point_rows(cloud)
    names = rows.dtype.names or ()
    time, reason, span = _time(rows, header_stamp(cloud))
    own = rows.dtype.itemsize == OWN_STEP and all(rows.dtype.fields[name][1] == OWN.get(name) for name in names)
    if own:
        compensated, why = True, "the layout of `drivesplat mcap`, whose points are compensated"
    elif time == "null":
        compensated, why = True, "without times of points they cannot be compensated: they are taken as they are"
    else:
        compensated, why = False, "drivers write points where they were measured; true if a node compensated them"
    ring = next((name for name in RINGS if name in names), None)
    intensity = next((name for name in INTENSITIES if name in names), None)
    scale, scaled = _scale(rows, intensity)
    return CloudLayout(
        time, reason, span, compensated, why, ring or "null",
        "index of the beam" if ring else "no field has the index of the beam", intensity or "null", scale, scaled,
    )  # fmt: skip


def _time(rows: np.ndarray, stamp: int) -> tuple[str, str, float]:
    """The value of `time`, its reason, and the seconds that the times span. The unit is the one in which they span a
    revolution."""
    field = next((name for name in TIMES if name in (rows.dtype.names or ())), None)
    if field is None:
        return "null", "no field has the times of points", 0.0
    every = rows[field].astype(np.float64)
    every = every[np.isfinite(every)]
    values = every[every != 0]  # points without a return may have no time
    if not len(values) or not np.ptp(every):
        return "null", f"all of {field} is the same", 0.0
    absolute = float(np.median(np.abs(values))) > 100 * float(np.ptp(values))
    span = float(np.ptp(values if absolute else every))
    fitting = [unit for unit, factor in NANOSECONDS.items() if MIN_SPAN_S <= span * factor * 1e-9 < MAX_SPAN_S]
    if not fitting:
        return "null", f"{field} spans {span:g}, which is no revolution in s, ms, us or ns", 0.0
    unit = fitting[0]
    said = f"{TIMES[field]} name; spans a revolution in {unit}"
    if not absolute:
        counts_from = "stamp"
        said += f", {'at and before' if np.median(values) < 0 else 'from'} the stamp"
    elif abs(float(np.median(values)) * NANOSECONDS[unit] - stamp) * 1e-9 <= MAX_OFFSET_S:
        counts_from = "epoch"
        said += ", since 1970 as the stamp"
    else:
        counts_from = "start"
        said += ", on another clock than the stamp"
    return f"{{field: {field}, unit: {unit}, counts_from: {counts_from}}}", said, span * NANOSECONDS[unit] * 1e-9


def _scale(rows: np.ndarray, field: str | None) -> tuple[float, str]:
    if field is None:
        return 1.0, "there is no intensity"
    values = rows[field].astype(np.float64)
    values = values[np.isfinite(values)]
    most = float(values.max()) if len(values) else 0.0
    if rows.dtype[field].itemsize == 1:
        return 255.0, "8 bits"
    for scale in (1.0, 255.0):
        if most <= scale:
            return scale, f"up to {most:g} in the first sweep"
    return float(np.percentile(values, 99)), f"99 % of the first sweep are below it, the highest is {most:g}"
