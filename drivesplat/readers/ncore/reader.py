"""Reads an NCore clip into a `Scene`.

A frame lasts from its start to its end, and the clip has the sensor's pose at both. An image has the pose between them,
and the velocity that leads from one to the other, so that the first line of pixels is seen from the pose at the start
and the last from that at the end. With a global shutter the image is that of the start. LiDAR rays have times of their
own: `Sweep.motion` moves them.

Key frames are the sweeps of the LiDAR with the most, without LiDAR the images of the first camera. The world has the
axes of NCore's `world_global` where that is upright, otherwise those of `world`: ECEF has no vertical axis.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import MAX_MOUNT, MAX_READOUT_S, checked_transform, require_increasing
from drivesplat.readers.drive.reader import chosen_recordings, nominal_rate
from drivesplat.readers.drive_checks import require_microseconds
from drivesplat.readers.ncore.calibration import camera_of, is_global, lidar_of
from drivesplat.readers.ncore.clip import Clip, open_clip, refusing
from drivesplat.readers.ncore.layout import clip_files, frame_times, key_frame_sensor, known_frames, middle
from drivesplat.readers.ncore.pose_graph import UPRIGHT
from drivesplat.readers.ncore.tracks import tracks_of
from drivesplat.readers.outline import frames_beyond, unknown_camera
from drivesplat.scene.lens import central_intrinsics
from drivesplat.scene.rigid import interpolate, inverse, rigid
from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.scene.sensors import Camera, SweepMotion
from drivesplat.settings.extract import SceneSource

READER = "ncore"
RIG, WORLD, GLOBAL = "rig", "world", "world_global"
MAX_SWEEP_US = 10_000_000
KNOT_US = 5_000
"""Least interval in microseconds between poses of a sweep's motion; over it an acceleration of 1 g moves 0.03 mm."""


def read(root: Path, source: SceneSource, scene_tables: Path | None = None) -> Scene:
    """The scene of `source`, without the dataset's name. Paths of images and sweeps are relative to the folder into
    which `drivesplat.readers.ncore.unpack` writes them.

    `source.sweeps` adds the images between key frames, `source.lidar_sweeps` the LiDAR sweeps. `source.frames` =
    (first, last + 1) keeps these key frames, renumbered from 0, and the recordings between them. Recordings during
    which the path of the rig is unknown are left out. Raises DatasetError naming the first fault.
    """
    return scene_of(open_clip(clip_files(root, source.scene)), source)


def scene_of(clip: Clip, source: SceneSource) -> Scene:
    if fault := unknown_camera(source.scene, sorted(clip.cameras), source.cameras):
        raise DatasetError(fault)
    key_sensor = key_frame_sensor(clip.metadata)
    if key_sensor is None:
        raise DatasetError(
            f"scene {source.scene}: no image and no sweep of the clip is recorded on the path of its rig"
        )
    every = [middle(*frame) for frame in known_frames(clip.metadata, *key_sensor)]
    component, name = key_sensor
    key_times = require_increasing(every, [str(time) for time in every], f"frame of {component[:-1]} {name} at")
    require_microseconds(every, f"scene {source.scene}")
    if fault := frames_beyond(source.scene, len(every), source.frames):
        raise DatasetError(fault)
    key_times = key_times[slice(*(source.frames or (None, None)))]
    upright = _upright_global(clip)
    first = upright @ clip.poses.at(RIG, WORLD, [int(key_times[0])])[0]
    reading = _ClipReading(clip, key_times, rigid(np.eye(3), -first[:3, 3]) @ upright)
    cameras = {name: reading.camera(name) for name in source.cameras}
    frames = [frame for camera in cameras.values() for frame in reading.frames(camera, source.sweeps)]
    sweeps = [sweep for name in sorted(clip.lidars) for sweep in reading.sweeps(name, source.lidar_sweeps)]
    return Scene(
        name=source.scene,
        dataset="",
        version="v4",
        description=_description(clip, int(key_times[0])),
        origin=first[:3, 3].copy(),
        key_frame_timestamps=key_times,
        frames=tuple(frames),
        sweeps=tuple(sweeps),
        tracks=tuple(tracks_of(clip.observations, clip.poses, reading.world_to_scene, key_times)),
        poses=READER,
        key_frame_hz=nominal_rate(key_times),
        key_frame_range=list(source.frames) if source.frames else None,
        cameras=tuple(cameras.values()),
        lidars=tuple(reading.lidar(name) for name in dict.fromkeys(sweep.lidar for sweep in sweeps)),
    )


def _upright_global(clip: Clip) -> np.ndarray:
    """The world of a clip in `world_global` (4, 4) where the two have one vertical axis, otherwise the identity."""
    if GLOBAL not in clip.poses or WORLD not in clip.poses:
        return np.eye(4)
    first, last = clip.poses.span(WORLD, GLOBAL)
    if (first, last) != (-np.inf, np.inf):
        raise DatasetError(f"clip {clip.name}: the pose of {WORLD} in {GLOBAL} changes over time; it must be constant")
    pose = clip.poses.at(WORLD, GLOBAL, [0])[0]
    return pose if pose[2, 2] >= UPRIGHT else np.eye(4)


def _description(clip: Clip, time: int) -> str:
    """The sequence, and where in `world_global` the drive begins."""
    sequence = f"NCore sequence {''.join(c for c in clip.sequence[:200] if c.isprintable())}"
    if GLOBAL not in clip.poses:
        return sequence
    x, y, z = clip.poses.at(RIG, GLOBAL, [time])[0][:3, 3]
    return f"{sequence}, which begins at {x:.3f}, {y:.3f}, {z:.3f} in {GLOBAL}"


@dataclass(frozen=True)
class _ClipReading:
    """A clip with its key frames, and the clip's world in that of the scene."""

    clip: Clip
    key_times: np.ndarray
    world_to_scene: np.ndarray

    def camera(self, name: str) -> Camera:
        """A camera, with the median readout time of its images."""
        durations = [end - start for start, end in frame_times(self.clip.metadata, "cameras", name)]
        readout_s = float(np.median(durations)) * 1e-6 if durations else None
        return camera_of(name, self._camera_model(name), readout_s)

    def lidar(self, name: str) -> Any:
        with refusing(f"LiDAR {name}: its model"):
            return lidar_of(name, self.clip.intrinsics.get_lidar_model_parameters(name))

    def frames(self, camera: Camera, between: bool) -> Iterator[Frame]:
        """The images of a camera at key frames and, if asked for, between them."""
        at_start = is_global(self._camera_model(camera.name))
        intrinsics = central_intrinsics(camera)
        recorded = known_frames(self.clip.metadata, "cameras", camera.name)
        times = [start if at_start else middle(start, end) for start, end in recorded]
        require_increasing(times, [f"{camera.name}/{time}" for time in times], "image")
        for number, index, is_key_frame in chosen_recordings(times, [None] * len(times), self.key_times, between):
            start, end = recorded[number]
            token = f"{camera.name}/{end}"
            if end - start > MAX_READOUT_S * 1e6:
                raise DatasetError(f"image {token}: it lasts {(end - start) * 1e-6:g} s, more than {MAX_READOUT_S:g} s")
            sensor, rig = (self._in_scene(frame, [start, end]) for frame in (camera.name, RIG))
            share = 0.0 if at_start else 0.5
            velocity = None if at_start or start == end else velocity_between(*sensor, (end - start) * 1e-6)
            yield Frame(
                camera=camera.name,
                timestamp=times[number],
                image_path=f"images/{camera.name}/{times[number]}",
                width=camera.width,
                height=camera.height,
                intrinsics=intrinsics,
                camera_to_world=interpolate(sensor[0], sensor[1], share),
                ego_to_world=interpolate(rig[0], rig[1], share),
                is_key_frame=is_key_frame,
                sample_index=index,
                token=token,
                camera_velocity=velocity,
            )

    def sweeps(self, name: str, between: bool) -> Iterator[Sweep]:
        """The sweeps of a LiDAR at key frames and, if asked for, between them."""
        recorded = known_frames(self.clip.metadata, "lidars", name)
        times = [middle(start, end) for start, end in recorded]
        require_increasing(times, [f"{name}/{time}" for time in times], "sweep")
        for number, index, is_key_frame in chosen_recordings(times, [None] * len(times), self.key_times, between):
            (start, end), time = recorded[number], times[number]
            token = f"{name}/{end}"
            if end - start > MAX_SWEEP_US:
                raise DatasetError(f"sweep {token}: it lasts {(end - start) * 1e-6:g} s")
            mount = self.clip.poses.at(name, RIG, [time])[0]
            checked_transform(mount.tolist(), f"LiDAR {name}", MAX_MOUNT)
            pose = self._in_scene(name, [time])[0]
            inside = np.array(self.clip.poses.times_between(RIG, WORLD, start, end), dtype=np.int64)
            inside = inside[np.unique(inside // KNOT_US, return_index=True)[1]]
            knots = np.unique([start, *inside, end])
            ego_to_sweep = inverse(pose) @ self._in_scene(RIG, knots.tolist())
            motion = SweepMotion((knots - time) * 1e-6, ego_to_sweep, mount)
            yield Sweep(f"sweeps/{name}/{time}.npz", time, pose, is_key_frame, index, token, name, READER, motion)

    def _in_scene(self, frame: str, times: list[int]) -> np.ndarray:
        """A frame of reference in the world of the scene (n, 4, 4)."""
        return self.world_to_scene @ self.clip.poses.at(frame, WORLD, times)

    def _camera_model(self, camera: str) -> Any:
        with refusing(f"camera {camera}: its model"):
            return self.clip.intrinsics.get_camera_model_parameters(camera)


def velocity_between(start: np.ndarray, end: np.ndarray, seconds: float) -> np.ndarray:
    """The velocity (6,), linear (m/s) and angular (rad/s), that leads from one pose (4, 4) to another in `seconds`,
    along the axes of the pose between them."""
    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    between = interpolate(start, end, 0.5)
    return np.concatenate([between[:3, :3].T @ (end[:3, 3] - start[:3, 3]), turn]) / seconds
