"""Scans from the returns of sweeps: the grid of rays that a spinning LiDAR fires, with what each of them returned.

Files hold returns alone. The scan pattern is rebuilt from rings and evenly spaced firings; a ray without a return is a
hole.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.outline import unknown_beams
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scan import Scan, ScanRays, wrapped
from drivesplat.scene.scene import Sweep
from drivesplat.scene.sensors import Lidar, LidarReturns, Spin

SensorPoses = Callable[[np.ndarray], np.ndarray]
"""The poses (n, 4, 4) of the sensor in its frame at the sweep's timestamp, at offsets (n,) in seconds from it."""
MIN_RANGE = 0.5
"""Metres within which nothing is measured: some files give rays without a return the range 0."""
STEPS = 6
"""Iterations to find the time and azimuth at which a spinning sensor met a return."""
MAX_RESIDUAL = 1e-4
"""Fraction of a revolution by which a return's time may differ from that of its azimuth."""
MIN_COMPARED = 1000
"""Minimum number of returns that are compared with known beams."""
MAX_BEYOND, MAX_MEDIAN_DEVIATION = 0.2, 0.46
"""Of returns without rings: the maximum share that is more than half the spacing of beams from the nearest beam, and
the maximum median of these distances in that unit. The median is 0.5 where returns lie anywhere."""
MIN_SPACING = 1e-5
"""Half of the spacing of beams in radians below which two are one."""
NEAR_ENDS = 0.1
"""Fraction of a revolution before its end and after its beginning in which a return may belong to either."""


class SeenReturns(NamedTuple):
    """Returns as the sensor saw them at their own times: offsets in seconds, azimuths and elevations in radians, ranges
    in metres, (n,) each."""

    offsets_s: np.ndarray
    azimuths: np.ndarray
    elevations: np.ndarray
    ranges: np.ndarray


def sensor_poses(sweep: Sweep, sweeps: Sequence[Sweep]) -> SensorPoses:
    """The motion of the sensor about a sweep: its own, where the dataset gives it, or that between the sweeps of the
    same LiDAR. Position is linear and rotation slerp in between; both are extrapolated beyond the ends."""
    motion = sweep.motion
    if motion is not None:
        return _interpolated(motion.offsets_s, motion.ego_to_sweep @ motion.sensor_to_ego)
    poses = {(s.timestamp - sweep.timestamp) * 1e-6: s.sensor_to_world for s in sweeps if s.lidar == sweep.lidar}
    seconds = sorted({0.0, *poses})
    world_to_sweep = inverse(sweep.sensor_to_world)
    return _interpolated(
        np.array(seconds), np.stack([world_to_sweep @ poses.get(second, sweep.sensor_to_world) for second in seconds])
    )


def _interpolated(seconds: np.ndarray, poses: np.ndarray) -> SensorPoses:
    """Poses at any time from those (k, 4, 4) at increasing `seconds` (k,)."""
    if len(seconds) == 1:
        return lambda offsets: np.repeat(poses, len(offsets), axis=0)
    turns = Rotation.from_matrix(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]).as_rotvec()

    def at(offsets: np.ndarray) -> np.ndarray:
        i = np.clip(np.searchsorted(seconds, offsets, side="right") - 1, 0, len(seconds) - 2)
        fraction = ((offsets - seconds[i]) / (seconds[i + 1] - seconds[i]))[:, None]
        rotation = poses[i, :3, :3] @ Rotation.from_rotvec(fraction * turns[i]).as_matrix()
        return rigid(rotation, (1.0 - fraction) * poses[i, :3, 3] + fraction * poses[i + 1, :3, 3])

    return at


def mean_velocity(poses: SensorPoses, first_s: float, last_s: float) -> tuple[np.ndarray, np.ndarray]:
    """The sensor's mean velocity (3,) in m/s and angular velocity (3,) in rad/s between two offsets, in its frame at
    the sweep's timestamp; zeros where they are equal."""
    if first_s == last_s:
        return np.zeros(3), np.zeros(3)
    first, last = poses(np.array([first_s, last_s]))
    turn = Rotation.from_matrix(last[:3, :3] @ first[:3, :3].T).as_rotvec()
    return (last[:3, 3] - first[:3, 3]) / (last_s - first_s), turn / (last_s - first_s)


def scan_of(returns: LidarReturns, lidar: Lidar, poses: SensorPoses, spin: Spin | None = None) -> Scan:
    """The scan of a sweep's motion-compensated returns.

    Beams are rings (without rings, the nearest of `lidar.beam_elevations`), firings `lidar.azimuth_steps` evenly spaced
    azimuths, or as many as the gaps between returns suggest, each beam with its own shift. The nearest of several
    returns in one cell of this grid is kept; those within MIN_RANGE are none. Its ray has its exact direction; holes
    have the grid's. Times are those of the returns, or follow from `spin`; without either all rays leave at the sweep's
    timestamp. Of the two times that a return near the beginning of the revolution may have, the one that suits its
    ring's elevation better is taken.

    Raises DatasetError where neither rings nor beam elevations are known, or nothing says how many firings there are.

    Example:
        Two beams and four firings of a sensor that stands; the second beam has one return, to the left.

        >>> import numpy as np
        >>> from drivesplat.lidar.scans import scan_of
        >>> from drivesplat.scene.sensors import Lidar, LidarReturns
        >>> points = np.array([[5.0, 0.0, 0.0], [0.0, 6.0, 0.0], [-7.0, 0.0, 0.0], [0.0, 8.0, 0.8]])
        >>> returns = LidarReturns(points, rings=np.array([0, 0, 0, 1]))
        >>> lidar = Lidar("top", beam_elevations=np.array([0.0, 0.1]), azimuth_steps=4)
        >>> scan = scan_of(returns, lidar, lambda offsets: np.tile(np.eye(4), (len(offsets), 1, 1)))
        >>> np.degrees(scan.rays.azimuths[0]).round().tolist()
        [-180.0, -90.0, 0.0, 90.0]
        >>> scan.ranges.astype(float).round(2).tolist()
        [[7.0, 0.0, 5.0, 6.0], [0.0, 0.0, 0.0, 8.04]]
    """
    seen = _seen(returns, poses, spin)
    measured = seen.ranges >= MIN_RANGE
    columns = (returns.points, returns.intensity, returns.rings, returns.offsets_s)
    returns = LidarReturns(*(None if column is None else column[measured] for column in columns))
    offsets, azimuths, elevations, ranges = (values[measured] for values in seen)
    rings, beams = _beams(returns, lidar, elevations)
    steps = lidar.azimuth_steps
    if not steps:  # by the median gap between neighbouring returns of a beam
        order = np.lexsort([azimuths, rings])
        gaps = np.diff(azimuths[order])[np.diff(rings[order]) == 0]
        gaps = gaps[gaps > 1e-5]  # duplicated returns
        if not len(gaps):
            raise DatasetError(f"LiDAR {lidar.name}: a sweep with so few returns needs azimuth_steps to tell its rays")
        steps = max(1, round(2.0 * np.pi / float(np.median(gaps))))
    # The shift of a beam's firings from evenly spaced azimuths is the circular mean of its returns', or that of all.
    turns = np.exp(1j * steps * (azimuths + np.pi))
    of_beams = np.bincount(rings, turns.real, len(beams)) + 1j * np.bincount(rings, turns.imag, len(beams))
    phases = np.angle(np.where(np.bincount(rings, minlength=len(beams)) > 0, of_beams, turns.sum())) / steps
    columns = np.round((azimuths + np.pi - phases[rings]) * steps / (2.0 * np.pi)).astype(np.int64) % steps
    shape = (len(beams), steps)
    nearest = np.argsort(-ranges, kind="stable")  # of several values for one cell numpy keeps the last
    cells = (rings[nearest], columns[nearest])
    grid = -np.pi + phases[:, None] + 2.0 * np.pi * np.arange(steps) / steps

    def filled(empty: np.ndarray, values: np.ndarray) -> np.ndarray:
        array = np.broadcast_to(empty, shape).astype(np.float32)
        array[cells] = values[nearest]
        return array

    hole_offsets = spin.offsets_s(grid) if returns.offsets_s is None and spin else _of_firings(columns, offsets, steps)
    rays = ScanRays(
        wrapped(filled(wrapped(grid), azimuths)), filled(beams[:, None], elevations), filled(hole_offsets, offsets)
    )
    nothing, intensity = np.zeros(()), returns.intensity
    return Scan(
        rays, filled(nothing, np.ones(len(ranges))) > 0, filled(nothing, ranges),
        None if intensity is None else filled(nothing, np.nan_to_num(intensity)),
    )  # fmt: skip


def _seen(returns: LidarReturns, poses: SensorPoses, spin: Spin | None) -> SeenReturns:
    """The returns as the sensor saw them."""
    points = returns.points
    if returns.offsets_s is not None or spin is None:
        return _seen_at(points, poses, np.zeros(len(points)) if returns.offsets_s is None else returns.offsets_s)
    fractions = spin.fractions(np.arctan2(points[:, 1], points[:, 0]))
    seen, residual = _seen_in_turn(points, poses, spin, fractions)
    fractions = (seen.offsets_s - spin.start_s) / spin.revolution_s
    ends = np.flatnonzero(np.abs(fractions - 0.5) > 0.5 - NEAR_ENDS)
    if returns.rings is None or not len(ends):
        return seen
    other, other_residual = _seen_in_turn(points[ends], poses, spin, 1.0 - np.round(fractions[ends]))
    rings = returns.rings
    beams = _medians(seen.elevations, rings)[rings[ends]]
    off, other_off = np.abs(seen.elevations[ends] - beams), np.abs(other.elevations - beams)
    better = (other_residual < MAX_RESIDUAL) & ((other_off < off) | (residual[ends] >= MAX_RESIDUAL))
    for values, replaced in zip(seen, other, strict=True):
        values[ends[better]] = replaced[better]
    return seen


def _seen_at(points: np.ndarray, poses: SensorPoses, offsets: np.ndarray) -> SeenReturns:
    """Compensated points as the sensor saw them at these offsets."""
    x, y, z = np.einsum("nij,nj->in", inverse(poses(offsets)), np.column_stack([points, np.ones(len(points))]))[:3]
    return SeenReturns(offsets, np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), np.sqrt(x * x + y * y + z * z))


def _seen_in_turn(
    points: np.ndarray, poses: SensorPoses, spin: Spin, fractions: np.ndarray
) -> tuple[SeenReturns, np.ndarray]:
    """Compensated points as a spinning sensor saw them, and by which fraction of a revolution (n,) their times differ
    from those of their azimuths. `fractions` (n,) of the revolution are the first guess; no time leaves the revolution.
    """
    for _ in range(STEPS):
        seen = _seen_at(points, poses, spin.start_s + spin.revolution_s * fractions)
        change = (spin.fractions(seen.azimuths) - fractions + 0.5) % 1.0 - 0.5
        fractions = np.clip(fractions + change, 0.0, 1.0)
    return seen, np.abs(change)


def _beams(returns: LidarReturns, lidar: Lidar, elevations: np.ndarray) -> tuple[Int[np.ndarray, " n"], np.ndarray]:
    """The ring of each return, and the elevation (b,) of each ring: measured where the known ones are those of another
    sensor."""
    known, rings = lidar.beam_elevations, returns.rings
    if rings is None:
        if known is None:
            raise DatasetError(unknown_beams(lidar.name))
        nearest, deviations = _nearest(elevations, known)
        if len(elevations) >= MIN_COMPARED:
            beyond, median = float((deviations > 1.0).mean()), float(np.median(deviations))
            if beyond > MAX_BEYOND or median > MAX_MEDIAN_DEVIATION:
                raise DatasetError(
                    f"LiDAR {lidar.name}: its returns do not lie on its beam_elevations: {100 * beyond:.0f} % are more "
                    f"than half a beam away, and the median is {100 * median:.0f} % of half a beam (50 % where returns "
                    "lie anywhere). Give the rings of returns or their true elevations; a LiDAR without beams has "
                    "neither (docs/lidar.md)"
                )
        return nearest, known
    if known is not None and (not len(rings) or rings.max() < len(known)):
        present = np.unique(rings)
        if not len(present):
            return rings, known
        # Most rings lie nearest to their known elevations, unless these are of another sensor or in another order.
        nearest, _ = _nearest(_medians(elevations, rings)[present], known)
        are_of_rings = float(np.mean(nearest == present)) >= 0.5
        return rings, known if are_of_rings else _medians(elevations, rings, len(known))
    if not len(rings):
        raise DatasetError(f"LiDAR {lidar.name}: a sweep without returns needs beam_elevations to tell its rays")
    return rings, _medians(elevations, rings)


def _nearest(elevations: np.ndarray, known: np.ndarray) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The nearest of the `known` beams (b,) to elevations (n,), and the distances (n,) in halves of the spacing of
    beams on that side, which at the ends continues."""
    order = np.argsort(known)
    beams = known[order]
    found = np.searchsorted(0.5 * (beams[1:] + beams[:-1]), elevations)
    if len(beams) == 1:
        return order[found], np.zeros(len(elevations))
    gaps = np.diff(beams)
    above = elevations > beams[found]
    half = 0.5 * np.where(above, np.append(gaps, gaps[-1])[found], np.insert(gaps, 0, gaps[0])[found])
    return order[found], np.abs(elevations - beams[found]) / np.maximum(half, MIN_SPACING)


def _medians(elevations: np.ndarray, rings: np.ndarray, count: int = 0) -> Float[np.ndarray, " b"]:
    """The median elevation of each ring's returns, of at least `count` rings; those without returns lie between their
    neighbours."""
    present = np.unique(rings)
    numbers = np.arange(max(count, present.max() + 1))
    return np.interp(numbers, present, [np.median(elevations[rings == ring]) for ring in present])


def _of_firings(columns: np.ndarray, offsets: np.ndarray, steps: int) -> Float[np.ndarray, " steps"]:
    """The median offset in seconds of each firing's returns; those without returns take the nearest one's."""
    if not len(columns):
        return np.zeros(steps)
    order = np.lexsort([offsets, columns])
    present, first, counts = np.unique(columns[order], return_index=True, return_counts=True)
    around = np.concatenate([present - steps, present, present + steps])
    nearest = np.abs(around - np.arange(steps)[:, None]).argmin(axis=1) % len(present)
    return offsets[order][first + counts // 2][nearest]
