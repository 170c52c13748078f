"""Reads a drive folder into a `Scene`."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.faults import faults_of, is_unposed
from drivesplat.readers.drive.format import FILE, Drive, DriveFrame, DriveTrack, read_drive
from drivesplat.readers.drive.layout import scene_folder
from drivesplat.readers.drive.poses import EgoPath, matrix_of, reach_us
from drivesplat.readers.drive.sweep_file import beyond_poses
from drivesplat.readers.outline import frames_beyond, unknown_camera
from drivesplat.scene.lens import central_intrinsics
from drivesplat.scene.rigid import interpolate, inverse, rigid
from drivesplat.scene.scene import UNPOSED, Frame, Scene, Sweep, Track, place_of
from drivesplat.settings.extract import SceneSource

log = logging.getLogger(__name__)

READER = "drive"
CHECK = "drivesplat check"
VISIBILITY_LEVELS = (0.4, 0.6, 0.8)
"""Visible shares at which nuScenes' levels 2, 3 and 4 begin."""
MIN_TRACK_GAP, MAX_TRACK_GAP, MAX_INTERVALS = 3e5, 1e6, 1.5
"""Bounds of `max_track_gap` in microseconds, and its usual intervals between poses."""
MIN_POSES = 3
"""Poses from which on a track has a usual interval of its own."""


def read(root: Path, source: SceneSource, scene_tables: Path | None = None) -> Scene:
    """The scene of `source`, without the dataset's name. `root` holds its drive folder, or is it.

    `source.sweeps` adds the images between key frames, `source.lidar_sweeps` the LiDAR sweeps. `source.frames` =
    (first, last + 1) keeps these key frames, renumbered from 0, and the recordings between them. Image files are not
    opened. Raises DatasetError naming the first fault and how to list the others.
    """
    folder = scene_folder(root, source.scene)
    drive = read_drive(folder)
    faults = faults_of(drive)
    if faults:
        more = f" ({len(faults) - 1} more: `{CHECK} {folder}` lists them)" if len(faults) > 1 else ""
        raise DatasetError(f"{folder / FILE}: {faults[0]}{more}")
    if is_unposed(drive) and not source.poses_from_images:
        raise DatasetError(
            f"{folder / FILE}: there are no poses; add ego_poses, or set "
            "refine_poses: {enabled: true, start: images} to estimate them from the images (docs/poses.md)"
        )
    return scene_of(drive, folder, source)


def scene_of(drive: Drive, folder: Path, source: SceneSource) -> Scene:
    """The scene of a drive without faults; paths of files begin with `folder`. A drive of LiDAR alone has no frames,
    whatever the cameras of `source`; in one without poses the ego vehicle's pose is the identity at all times."""
    cameras = source.cameras if drive.frames else ()
    if fault := unknown_camera(source.scene, drive.cameras, cameras):
        raise DatasetError(fault)
    times, ego = key_frame_times(drive, source), EgoPath(drive)
    reading = _DriveReading(drive, folder, times, ego, origin_shift(drive, ego, int(times[0])))
    usual = usual_interval(drive.tracks)
    tracks = (sampled_track(track, times, reading.shift, max_track_gap(track, usual)) for track in drive.tracks)
    sweeps = tuple(sweep for lidar in drive.lidars for sweep in reading.sweeps(lidar, source.lidar_sweeps))
    return Scene(
        name=source.scene,
        dataset="",
        version=str(drive.version),
        description=drive.description,
        licence=drive.licence,
        origin=reading.shift if drive.origin is None else np.array(drive.origin),
        key_frame_timestamps=times,
        frames=tuple(frame for camera in cameras for frame in reading.frames(camera, source.sweeps)),
        sweeps=sweeps,
        tracks=tuple(track for track in tracks if track is not None),
        poses=UNPOSED if is_unposed(drive) else READER,
        key_frame_hz=nominal_rate(times),
        key_frame_range=list(source.frames) if source.frames else None,
        cameras=tuple(drive.cameras[name].sensor(name) for name in cameras),
        lidars=tuple(drive.lidars[name].sensor(name) for name in dict.fromkeys(sweep.lidar for sweep in sweeps)),
    )


def origin_shift(drive: Drive, ego: EgoPath, time: int) -> np.ndarray:
    """The translation (3,) that is subtracted from all poses: 0 where the drive states its origin, otherwise the ego
    vehicle's position at the first key frame or, without ego poses, at the first image or sweep."""
    if drive.origin is not None:
        return np.zeros(3)
    if len(ego) or is_unposed(drive):
        return ego.at(time)[:3, 3].copy()
    if not drive.frames:
        sweep = min(drive.sweeps, key=lambda sweep: sweep.timestamp)
        assert sweep.lidar_to_world is not None
        mount = matrix_of(drive.lidars[sweep.lidar].sensor_to_ego)
        return (matrix_of(sweep.lidar_to_world) @ inverse(mount))[:3, 3].copy()
    return ego_of(drive, min(drive.frames, key=lambda frame: frame.timestamp), ego)[:3, 3].copy()


def nominal_rate(times: np.ndarray) -> float:
    """The rate of key frames in Hz, a whole number where it is one within a twentieth."""
    if len(times) < 2:
        return 1.0
    rate = 1e6 / float(np.median(np.diff(times)))
    return float(round(rate)) if round(rate) and abs(rate / round(rate) - 1.0) < 0.05 else round(rate, 3)


def key_frame_times(drive: Drive, source: SceneSource) -> np.ndarray:
    """The times (n,) of the key frames that `source` selects: those given, those of the first camera's images,
    or without images those of the first LiDAR's sweeps."""
    times = drive.key_frames
    if times is None:
        for camera in drive.cameras:
            of_camera = [frame for frame in drive.frames if frame.camera == camera]
            marked = [frame for frame in of_camera if frame.key_frame] or of_camera
            if marked:
                times = tuple(sorted(frame.timestamp for frame in marked))
                break
    if times is None:
        first = next(lidar for lidar in drive.lidars if any(sweep.lidar == lidar for sweep in drive.sweeps))
        times = tuple(sorted(sweep.timestamp for sweep in drive.sweeps if sweep.lidar == first))
    found = np.array(times, dtype=np.int64)
    if fault := frames_beyond(source.scene, len(found), source.frames):
        raise DatasetError(fault)
    return found[slice(*(source.frames or (None, None)))]


def chosen_recordings(
    times: Sequence[int], marked: Sequence[bool | None], key_times: np.ndarray, between: bool
) -> list[tuple[int, int, bool]]:
    """Of the recordings of a sensor at increasing `times`: number, key frame, and whether it is that key frame's own.
    A key frame's own recording is the nearest within half an interval, of those `marked` where any are. With `between`
    also those from the first key frame's own to the last's."""
    if not len(times):
        return []
    interval = float(np.median(np.diff(key_times))) if len(key_times) > 1 else 1e6
    every = np.array(times, dtype=np.int64)
    candidates = np.flatnonzero([bool(mark) for mark in marked]) if any(marked) else np.arange(len(every))
    candidates = candidates[[marked[i] is not False for i in candidates]]
    own: dict[int, int] = {}
    for index, key in enumerate(key_times):
        distance = np.abs(every[candidates] - key)
        if len(candidates) and distance.min() <= interval / 2:
            own[int(candidates[np.argmin(distance)])] = index
    if not own:
        return []
    kept = range(min(own), max(own) + 1) if between else sorted(own)
    nearest = [int(np.argmin(np.abs(key_times - every[i]))) for i in kept]
    return [(i, own.get(i, near), i in own) for i, near in zip(kept, nearest, strict=True)]


def usual_interval(tracks: Sequence[DriveTrack]) -> float:
    """The median time in microseconds between poses of a drive's tracks; 0 if there are none."""
    intervals = [np.diff([pose.timestamp for pose in track.poses]) for track in tracks if len(track.poses) > 1]
    return float(np.median(np.concatenate(intervals))) if intervals else 0.0


def max_track_gap(track: DriveTrack, usual: float) -> float:
    """The time in microseconds between two poses of a track over which it is interpolated: MAX_INTERVALS of the `usual`
    interval between poses of the drive or of this track, whichever is longer, from MIN_TRACK_GAP to MAX_TRACK_GAP. Over
    a longer one the object is absent."""
    own = usual_interval([track]) if len(track.poses) >= MIN_POSES else 0.0
    return float(np.clip(MAX_INTERVALS * max(usual, own), MIN_TRACK_GAP, MAX_TRACK_GAP))


def sampled_track(track: DriveTrack, key_times: np.ndarray, origin: np.ndarray, max_gap: float) -> Track | None:
    """A track at the key frames during which it is annotated; None where there are none. It is interpolated between
    poses at most `max_gap` microseconds apart."""
    times = np.array([pose.timestamp for pose in track.poses], dtype=np.int64)
    poses = [matrix_of(pose) for pose in track.poses]
    indices, matrices, levels = [], [], []
    for index, key in enumerate(key_times):
        after = int(np.searchsorted(times, key))
        if after < len(times) and times[after] == key:
            matrix, nearest = poses[after], after
        elif 0 < after < len(times) and times[after] - times[after - 1] <= max_gap:
            share = float((key - times[after - 1]) / (times[after] - times[after - 1]))
            matrix, nearest = interpolate(poses[after - 1], poses[after], share), after - (share < 0.5)
        else:
            continue
        indices.append(index)
        matrices.append(rigid(matrix[:3, :3], matrix[:3, 3] - origin))
        levels.append(visibility_level(track.poses[nearest].visibility))
    if not indices:
        return None
    return Track(
        id=track.id,
        object_class=track.object_class,
        category=track.category or track.object_class.value,
        size=np.array(track.size),
        timestamps=key_times[indices],
        sample_indices=np.array(indices, dtype=np.int64),
        object_to_world=np.stack(matrices),
        visibility=np.array(levels, dtype=np.int64),
    )


def visibility_level(share: float | None) -> int:
    """A visible share as a level from 1 to 4; 0: unknown."""
    return 0 if share is None else 1 + sum(share >= limit for limit in VISIBILITY_LEVELS)


def ego_of(drive: Drive, frame: DriveFrame, ego: EgoPath) -> np.ndarray:
    """Ego to world (4, 4) at an image's time, in the drive's world."""
    if frame.ego_to_world is not None:
        return matrix_of(frame.ego_to_world)
    if frame.camera_to_world is not None:
        return matrix_of(frame.camera_to_world) @ inverse(matrix_of(drive.cameras[frame.camera].sensor_to_ego))
    return ego.at(frame.timestamp)


@dataclass(frozen=True)
class _DriveReading:
    """A drive in `folder` with its key frames, its ego path and the translation that is subtracted from poses."""

    drive: Drive
    folder: Path
    key_times: np.ndarray
    ego: EgoPath
    shift: np.ndarray

    def frames(self, name: str, between: bool) -> Iterator[Frame]:
        """The images of a camera at key frames and, if asked for, between them."""
        camera, sensor_to_ego = self.drive.cameras[name], matrix_of(self.drive.cameras[name].sensor_to_ego)
        intrinsics = central_intrinsics(camera.sensor(name))
        records = sorted((f for f in self.drive.frames if f.camera == name), key=lambda frame: frame.timestamp)
        times, marked = [frame.timestamp for frame in records], [frame.key_frame for frame in records]
        for number, index, is_key_frame in chosen_recordings(times, marked, self.key_times, between):
            frame = records[number]
            ego_to_world = self._shifted(ego_of(self.drive, frame, self.ego))
            camera_to_world = ego_to_world @ sensor_to_ego
            if frame.camera_to_world is not None:
                camera_to_world = self._shifted(matrix_of(frame.camera_to_world))
            yield Frame(
                camera=name,
                timestamp=frame.timestamp,
                image_path=str(self.folder / frame.file),
                width=camera.width,
                height=camera.height,
                intrinsics=intrinsics,
                camera_to_world=camera_to_world,
                ego_to_world=ego_to_world,
                is_key_frame=is_key_frame,
                sample_index=index,
                token=f"{name}/{frame.timestamp}",
                readout_middle_s=frame.readout_middle_s,
                camera_velocity=None if frame.camera_velocity is None else np.array(frame.camera_velocity),
            )

    def sweeps(self, name: str, between: bool) -> Iterator[Sweep]:
        """The sweeps of a LiDAR at key frames and, if asked for, between them."""
        records = sorted((s for s in self.drive.sweeps if s.lidar == name), key=lambda sweep: sweep.timestamp)
        lidar, times = self.drive.lidars[name], [sweep.timestamp for sweep in records]
        sensor_to_ego = matrix_of(lidar.sensor_to_ego)
        for number, index, is_key_frame in chosen_recordings(times, [None] * len(times), self.key_times, between):
            sweep = records[number]
            own = sweep.lidar_to_world
            pose = self._shifted(matrix_of(own) if own else self.ego.at(sweep.timestamp) @ sensor_to_ego)
            path, token = str(self.folder / sweep.file), f"{name}/{sweep.timestamp}"
            motion = None
            if not lidar.motion_compensated:
                motion = self.ego.motion(sweep.timestamp, sensor_to_ego, lidar.revolution_s)
            found = Sweep(path, sweep.timestamp, pose, is_key_frame, index, token, name, READER, motion)
            if not lidar.motion_compensated and (fault := beyond_poses(found, reach_us(lidar.revolution_s))):
                log.warning("%s: LiDAR file %s %s; left out", place_of(found), path, fault)
            else:
                yield found

    def _shifted(self, pose: np.ndarray) -> np.ndarray:
        shifted = pose.copy()
        shifted[:3, 3] -= self.shift
        return shifted
