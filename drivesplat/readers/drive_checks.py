"""Checks of a whole drive that all readers share: chains of records, unique tokens, units of time, tracks and LiDAR
returns. Errors and warnings name the record."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import require_none
from drivesplat.readers.record_names import named
from drivesplat.scene.scene import Scene
from drivesplat.scene.sensors import LidarReturns

MIN_STEP_US = 1000
"""Minimum median step between recordings of a sensor in microseconds. Seconds and milliseconds are below it."""
MAX_SPAN_US = 3_600_000_000
"""Maximum length of a drive in microseconds."""
MAX_SPEED = 120.0
"""Speed in m/s above which an object or the ego vehicle is taken to jump."""
MAX_NAMED = 10
"""Maximum number of tracks that are named."""
MAX_RANGE = 1000.0
"""Maximum distance in metres of a LiDAR return: no LiDAR on a vehicle measures as far."""


def require_unique(tokens: Sequence[str], table: str) -> None:
    """Raises DatasetError naming a token that two records of a table have."""
    if len(set(tokens)) < len(tokens):
        token, _ = Counter(tokens).most_common(1)[0]
        raise DatasetError(f"{named(table, token)}: two records have this token; it must be unique")


def chain(first: str, following: Callable[[str], str], table: str) -> list[str]:
    """The tokens of a linked list from `first`; `following` gives the next token, "" at the end.

    Raises DatasetError naming the record that leads back to an earlier one.
    """
    tokens = {first: None}
    last = first
    while token := following(last):
        if token in tokens:
            raise DatasetError(
                f"{named(table, last)}: its next is {token}, which comes before it: the chain is a circle"
            )
        tokens[token] = None
        last = token
    return list(tokens)


def require_microseconds(key_frame_times: Sequence[int] | np.ndarray, record: str) -> None:
    """Raises DatasetError naming `record` if timestamps of key frames must have another unit."""
    require_none(clock_faults(key_frame_times, f"{record}: its key frames"))


def clock_faults(timestamps: Sequence[int] | np.ndarray, records: str) -> Iterator[str]:
    """A sentence, which begins with `records` in the plural, if the timestamps of one sensor follow each other so
    closely, or span so long, that their unit cannot be the microsecond."""
    times = np.sort(np.array(timestamps, dtype=np.int64))
    if len(times) < 2:
        return
    step = float(np.median(np.diff(times)))
    span = step * (len(times) - 1)  # without single times that are wrong
    if step < MIN_STEP_US:
        yield (
            f"{records} are {step:g} microseconds apart, less than a millisecond; timestamps must be microseconds, "
            "neither seconds nor milliseconds"
        )
    elif span > MAX_SPAN_US:
        yield (
            f"{records} span {span * 1e-6:.0f} s; timestamps must be microseconds, not nanoseconds, and a drive may be "
            "an hour long"
        )


def returns_fault(returns: LidarReturns) -> str | None:
    """The fault of the returns of a sweep's file, as the end of a sentence; None if there is none."""
    if not len(returns.points):
        return "is corrupt (it has no return with finite coordinates)"
    farthest = float(np.abs(returns.points).max())
    if not farthest <= MAX_RANGE:
        return f"is corrupt (a return is {farthest:.3g} m away; coordinates must be metres, in the sensor's frame)"
    if returns.intensity is not None and not np.isfinite(returns.intensity).all():
        return "is corrupt (an intensity is not finite)"
    if returns.offsets_s is not None and not np.isfinite(returns.offsets_s).all():
        return "is corrupt (a time is not finite)"
    return None


def jumps(scene: Scene) -> list[str]:
    """A sentence if the ego vehicle has a speed above MAX_SPEED, otherwise one for every track that has it between two
    annotations (at most MAX_NAMED). These are warnings, since annotations and positions have errors. The ego vehicle's
    path is given by the images of each camera, without images by the sweeps of each LiDAR."""
    recorded = [(frame.camera, frame.timestamp, frame.ego_to_world) for frame in scene.frames]
    if not recorded:
        recorded = [(sweep.lidar, sweep.timestamp, sweep.sensor_to_world) for sweep in scene.sweeps]
    for sensor in dict.fromkeys(name for name, _, _ in recorded):
        own = sorted(((time, pose) for name, time, pose in recorded if name == sensor), key=lambda item: item[0])
        where = _jump(np.array([time for time, _ in own]), np.stack([pose[:3, 3] for _, pose in own]))
        if where:
            return [f"the ego vehicle jumps, {where}: check its poses, that they are metres, and their times"]
    tracks = []
    for track in scene.tracks:
        where = _jump(track.timestamps, track.object_to_world[:, :3, 3])
        if where:
            tracks.append(f"track {track.id} ({track.category}) jumps, {where}: check its boxes")
    more = [f"{len(tracks) - MAX_NAMED} more tracks jump"] if len(tracks) > MAX_NAMED else []
    return [*tracks[:MAX_NAMED], *more]


def _jump(timestamps: np.ndarray, positions: np.ndarray) -> str | None:
    """The step above MAX_SPEED, if any, of positions (n, 3) at times (n,) in microseconds, in words."""
    seconds = np.diff(timestamps) * 1e-6
    distances = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    excess = distances - MAX_SPEED * seconds
    if not len(excess) or excess.max() <= 0:
        return None
    at = int(np.argmax(excess))
    return f"{distances[at]:.0f} m within {seconds[at]:.2f} s (from {timestamps[at]} to {timestamps[at + 1]})"
