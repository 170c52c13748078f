"""Faults of a drive.json whose structure is right: values that contradict each other or cannot be, a sentence each."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import (
    MAX_COORDINATE,
    MAX_MOUNT,
    checked_box_size,
    checked_intrinsics,
    order_faults,
    path_faults,
)
from drivesplat.readers.drive.format import Drive, Pose, TimedPose
from drivesplat.readers.drive.poses import MAX_POSE_GAP, matrix_of
from drivesplat.readers.drive_checks import clock_faults
from drivesplat.readers.record_names import shown
from drivesplat.scene.lens import coefficients_fault, lens_fault

MAX_ELEVATION = 1.6
"""Maximum elevation of a beam in radians; degrees are mostly beyond it."""
UNITS = {"seconds": 1e6, "milliseconds": 1e3, "nanoseconds": 1e-3}
"""Units that are taken for microseconds by mistake, and the microseconds in one."""
MAX_FROM_ORIGIN, MAX_SPAN = 10_000.0, 100_000.0
"""Metres from the origin, where it is given, to the first pose, and from there to any other: single precision, in which
models are trained, has steps of 1 mm at the first distance and of 8 mm at the second."""
MAX_FROM_PATH = 500.0
"""Metres from the ego vehicle's path within which at least one track begins."""


def faults_of(drive: Drive) -> list[str]:
    """The faults of a drive; if times have another unit than microseconds, only those, which cause others."""
    key_frames = drive.key_frames
    none = "key_frames: there is none; leave the key out to use all images of the first camera"
    return list(_unit_faults(drive)) or [
        *_sensor_faults(drive),
        *_timed_faults("ego_poses", drive.ego_poses),
        *_place_faults(drive),
        *_recording_faults(drive),
        *_track_faults(drive),
        *([none] if key_frames is not None and not key_frames else []),
        *order_faults(key_frames or (), lambda i: f"key_frames[{i}]"),
    ]


def _unit_faults(drive: Drive) -> Iterator[str]:
    """Faults of the unit of timestamps: of each sensor by itself, and of ego poses beside the others."""
    for name in drive.cameras:
        yield from clock_faults([f.timestamp for f in drive.frames if f.camera == name], f"frames of camera {name}")
    for name in drive.lidars:
        yield from clock_faults([s.timestamp for s in drive.sweeps if s.lidar == name], f"sweeps of lidar {name}")
    yield from clock_faults(drive.key_frames or (), "key_frames")
    recorded = [one.timestamp for one in (*drive.frames, *drive.sweeps)]
    if not recorded or not drive.ego_poses:
        return
    ratio = float(np.median(recorded)) / max(1.0, float(np.median([pose.timestamp for pose in drive.ego_poses])))
    for unit, factor in UNITS.items():
        if 0.5 < ratio / factor < 2.0:
            yield (
                f"ego_poses: timestamps are {unit}, those of frames and sweeps microseconds; multiply them by "
                f"{factor:g}, before they are rounded"
            )


def is_unposed(drive: Drive) -> bool:
    """Whether a drive has no poses at all: none of the vehicle, of images or of sweeps."""
    given = (pose for frame in drive.frames for pose in (frame.camera_to_world, frame.ego_to_world))
    return not drive.ego_poses and not any(given) and not any(sweep.lidar_to_world for sweep in drive.sweeps)


def _sensor_faults(drive: Drive) -> Iterator[str]:
    mounts = ((name, camera.sensor_to_ego) for name, camera in drive.cameras.items())
    yield from _pose_faults("cameras", mounts, MAX_MOUNT)
    for name, camera in drive.cameras.items():
        where = f"cameras.{name}"
        try:
            checked_intrinsics(camera.K, where, (camera.width, camera.height))
        except DatasetError as error:
            yield str(error)
            continue
        model, count = camera.distortion.model, len(camera.distortion.coefficients)
        fault = coefficients_fault(model, count)
        if fault is None and model != "none":
            fault = lens_fault(camera.sensor(name))
        if fault is not None:
            yield f"{where}: {fault}"
    yield from _pose_faults("lidars", ((name, lidar.sensor_to_ego) for name, lidar in drive.lidars.items()), MAX_MOUNT)
    for name, lidar in drive.lidars.items():
        steepest = max(map(abs, lidar.beam_elevations or ()), default=0.0)
        if steepest > MAX_ELEVATION:
            yield (
                f"lidars.{name}: its beam_elevations reach {steepest:g}; they are radians above the sensor's "
                "horizontal plane, at most 1.57"
            )
        if not lidar.motion_compensated and not drive.ego_poses and not is_unposed(drive):
            yield f"lidars.{name}: motion_compensated is false, but there are no ego_poses for motion compensation"


def _pose_faults(
    list_name: str, poses: Iterable[tuple[str | int, Pose]], bound: float = MAX_COORDINATE
) -> Iterator[str]:
    for name, pose in poses:
        where = f"{list_name}[{name}]" if isinstance(name, int) else f"{list_name}.{name}"
        try:
            matrix_of(pose, where, bound)
        except DatasetError as error:
            yield str(error)


def _timed_faults(list_name: str, poses: Sequence[TimedPose]) -> Iterator[str]:
    """Faults of the poses of one body over time. Jumps are warnings (`drive_checks.jumps`)."""
    yield from _pose_faults(list_name, enumerate(poses))
    yield from order_faults([pose.timestamp for pose in poses], lambda i: f"{list_name}[{i}]")


def _path_of(drive: Drive) -> list[tuple[int, tuple[float, ...]]]:
    """The times and positions of the ego vehicle and its sensors, in the order of time."""
    poses = [(pose.timestamp, pose.translation) for pose in drive.ego_poses]
    for frame in drive.frames:
        poses += [(frame.timestamp, p.translation) for p in (frame.camera_to_world, frame.ego_to_world) if p]
    poses += [(sweep.timestamp, s.translation) for sweep in drive.sweeps if (s := sweep.lidar_to_world)]
    return sorted(poses)


def _place_faults(drive: Drive) -> Iterator[str]:
    """The fault of poses that are too far from the world's origin, or from each other."""
    path = np.array([place for _, place in _path_of(drive)])
    if not len(path):
        return
    far = float(np.linalg.norm(path[0]))
    span = np.linalg.norm(path - path[0], axis=1)
    if drive.origin is not None and far > MAX_FROM_ORIGIN:
        yield (
            f"origin: poses are relative to it, yet the first one lies {far * 1e-3:.0f} km away; leave origin out "
            "where poses are global, or subtract it from them"
        )
    elif span.max() > MAX_SPAN:
        time = _path_of(drive)[int(np.argmax(span > MAX_SPAN))][0]
        yield (
            f"ego_poses: positions lie up to {span.max() * 1e-3:.0f} km from the first one, from time {time} on; has "
            "the UTM zone changed, or is the unit not the metre? All poses need one coordinate system"
        )


def _recording_faults(drive: Drive) -> Iterator[str]:
    """Faults of frames and sweeps."""
    if drive.frames and not drive.cameras:
        yield "cameras: there is none; images need their calibration (K and sensor_to_ego)"
    if not drive.frames and not drive.sweeps:
        yield "frames: there is none, and there are no sweeps"
    unposed = is_unposed(drive)
    if unposed and not (drive.frames and drive.sweeps):
        yield (
            "ego_poses: there is none, and no image or sweep has a pose of its own; poses can be estimated only where "
            "there are both images and LiDAR sweeps (docs/poses.md)"
        )
    for list_name, poses in (
        ("frames", ((i, pose) for i, f in enumerate(drive.frames) for pose in (f.camera_to_world, f.ego_to_world))),
        ("sweeps", ((i, sweep.lidar_to_world) for i, sweep in enumerate(drive.sweeps))),
    ):
        yield from _pose_faults(list_name, ((i, pose) for i, pose in poses if pose is not None))
    frames = [
        (f.camera, f.timestamp, f.file, f.camera_to_world is None and f.ego_to_world is None) for f in drive.frames
    ]
    moving = {name for name, lidar in drive.lidars.items() if drive.ego_poses and not lidar.motion_compensated}
    sweeps = [(s.lidar, s.timestamp, s.file, s.lidar_to_world is None or s.lidar in moving) for s in drive.sweeps]
    ego_times = np.array([pose.timestamp for pose in drive.ego_poses], dtype=np.int64)
    for list_name, kind, known, records in (
        ("frames", "camera", drive.cameras, frames),
        ("sweeps", "lidar", drive.lidars, sweeps),
    ):
        seen: dict[tuple[str, int], int] = {}
        for i, (sensor, time, file, needs_ego) in enumerate(records):
            where = f"{list_name}[{i}]"
            if sensor not in known:
                yield f"{where}: {kind} {shown(sensor)} is not in {kind}s; there are: {', '.join(known) or 'none'}"
            if (sensor, time) in seen:
                yield f"{where}: {list_name}[{seen[sensor, time]}] has the same {kind} and timestamp"
            seen[sensor, time] = i
            yield from path_faults(file, where, "file")
            if needs_ego and not unposed and (fault := _unposed(ego_times, time)):
                yield f"{where}: {fault}"


def _unposed(times: np.ndarray, time: int) -> str | None:
    """Why there is no ego pose at a time, or None; `times` (n,) are those of the ego poses."""
    if not len(times):
        return "there are no ego_poses, and it has no pose of its own"
    after = int(np.searchsorted(times, time))
    if after < len(times) and times[after] == time:
        return None
    if after in (0, len(times)):
        return f"its timestamp {time} is outside the ego poses' time, {times[0]} to {times[-1]}"
    if times[after] - times[after - 1] > MAX_POSE_GAP:
        return f"the ego poses around its time are {(times[after] - times[after - 1]) * 1e-6:.1f} s apart, at most 1"
    return None


def _track_faults(drive: Drive) -> Iterator[str]:
    ids: set[str] = set()
    for track in drive.tracks:
        where = f"track {track.id}"
        if track.id in ids:
            yield f"{where}: another track has this id"
        ids.add(track.id)
        try:
            checked_box_size(track.size, where)
        except DatasetError as error:
            yield str(error)
        yield from _timed_faults(f"{where}: poses", track.poses)
    # None of them may be there during the drive, or near its path.
    times = [one.timestamp for one in (*drive.frames, *drive.sweeps)]
    if not drive.tracks or not times:
        return
    count = len(drive.tracks)
    poses = [pose for track in drive.tracks for pose in track.poses]
    first, last = min(pose.timestamp for pose in poses), max(pose.timestamp for pose in poses)
    if first > max(times) or last < min(times):
        yield (
            f"tracks: {count} track{'s' if count > 1 else ''}, none has a pose during the drive ({min(times)} to "
            f"{max(times)}); theirs are at {first} to {last}: check their clock"
        )
        return
    path = _path_of(drive)
    if path:
        places = np.array([place for _, place in path])[:, :2]
        own = np.array([track.poses[0].translation[:2] for track in drive.tracks])
        nearest = float(cKDTree(places).query(own)[0].min())
        if nearest > MAX_FROM_PATH:
            yield (
                f"tracks: {count} track{'s' if count > 1 else ''}, none begins within {nearest:.0f} m of the vehicle's "
                "path: their poses must be in the world of ego_poses"
            )
