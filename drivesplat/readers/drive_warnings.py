"""All warnings about a drive whose records are sound: poses, sensors, boxes and clocks compared with each other, in
sentences. They do not stop a run: a camera may be mounted on its side, and a vehicle may reverse all the time."""

from typing import TypeVar

import numpy as np

from drivesplat.readers.drive_checks import jumps
from drivesplat.readers.image_agreement import image_warnings
from drivesplat.readers.sampled_sweeps import SampledSweep, sampled_sweeps
from drivesplat.readers.sweep_agreement import agreement_warnings
from drivesplat.readers.sweeps import sound_returns
from drivesplat.readers.track_plausibility import degrees_between, path_warnings, shape_warnings
from drivesplat.readers.track_returns import box_warnings, frame_warnings
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import UNPOSED, Frame, Scene, Sweep

T = TypeVar("T")
MIN_STEP = 0.3
"""Minimum distance in metres between two positions that give the direction of travel."""
MAX_TURN = 30.0
"""Degrees between heading and direction of travel, or between the vertical axes of the ego frame and the world."""
REVERSING = 150.0
"""Degrees from which on an upright vehicle may be one that reverses."""
MAX_ROLL = 45.0
"""Degrees between a camera's y axis and the downward direction of the vehicle."""
GROUND_RING, GROUND_HEIGHT, MIN_GROUND = (3.0, 12.0), 0.5, 0.1
"""Between these horizontal distances (metres) from the vehicle, at least this share of returns lies within this height
(metres) of the ground."""
SAMPLED_SWEEPS = 5
"""Sweeps of each LiDAR, and images of each camera, from which this is computed."""


def drive_warnings(scene: Scene) -> list[str]:
    """Sentences about what contradicts each other in a drive, with the measured figure and the likely cause. Reads a
    few sweeps and images."""
    found = [*jumps(scene), *pose_warnings(scene), *lidar_warnings(scene)]
    if scene.poses == UNPOSED or found:
        return [*found, *shape_warnings(scene.tracks)]
    sweeps = sampled_sweeps(scene)
    return [*agreement_warnings(sweeps), *image_warnings(scene, sweeps), *track_warnings(scene, sweeps)]


def track_warnings(scene: Scene, sweeps: list[SampledSweep]) -> list[str]:
    """Sentences about tracks: the first kind of mistake that is found, since it causes others."""
    return (
        shape_warnings(scene.tracks)
        or frame_warnings(scene, sweeps)
        or path_warnings(scene)
        or box_warnings(scene, sweeps)
    )


def pose_warnings(scene: Scene) -> list[str]:
    """Sentences about ego poses that contradict the vehicle's motion, which is along its x axis, on the ground; and
    about cameras that are not upright."""
    if scene.poses == UNPOSED or not scene.frames:
        return []
    found = []
    poses = np.stack([frame.ego_to_world for frame in _frames_of(scene, scene.frames[0].camera)])
    tilt = float(np.median(degrees_between(poses[:, 2, 2])))
    if tilt > MAX_TURN:
        found.append(
            f"the ego vehicle is tilted by {tilt:.0f} degrees (median): its z axis must point up, as the world's does; "
            "check that rotations of poses are w, x, y, z and map the ego frame to the world"
        )
    apart = poses[:1]
    for pose in poses[1:]:
        if np.linalg.norm(pose[:3, 3] - apart[-1, :3, 3]) > MIN_STEP:
            apart = np.concatenate([apart, pose[None]])
    steps = np.diff(apart[:, :3, 3], axis=0)
    along = np.einsum("ni,ni->n", steps, apart[:-1, :3, 0]) / np.linalg.norm(steps, axis=1)
    angle = float(np.median(degrees_between(along))) if len(steps) else 0.0
    if angle > MAX_TURN and not (angle > REVERSING and tilt <= MAX_TURN):
        found.append(
            f"the ego vehicle moves at {angle:.0f} degrees to its x axis (median of {len(steps)} steps): x must "
            "point forward; check that rotations of poses are w, x, y, z and map the ego frame to the world, not the "
            "reverse"
        )
    elif angle > REVERSING:
        found.append(
            f"the ego vehicle moves backwards (median of {len(steps)} steps): its x axis must point forward; "
            "unless it reverses, check that rotations of poses are w, x, y, z"
        )
    for camera in dict.fromkeys(frame.camera for frame in scene.frames):
        mount = _frames_of(scene, camera)[0].camera_to_ego
        roll = float(degrees_between(-mount[2:3, 1])[0])
        if roll > MAX_ROLL:
            found.append(
                f"camera {camera}: its y axis, which points down in the image, is {roll:.0f} degrees from the "
                "vehicle's downward direction: check that the axes of sensor_to_ego are x right, y down, z forward"
            )
    return found


def lidar_warnings(scene: Scene) -> list[str]:
    """Sentences about LiDARs with hardly any return near the ground, and cameras whose images no return falls into.
    Reads a few sweeps, without those whose file has a fault. Without images nothing is known of the vehicle's path, and
    there are none.
    """
    if scene.poses == UNPOSED or not scene.frames:
        return []
    found = []
    by_lidar = {lidar.name: [sweep for sweep in scene.sweeps if sweep.lidar == lidar.name] for lidar in scene.lidars}
    for lidar, sweeps in by_lidar.items():
        near = total = 0
        for sweep in _spread(sweeps):
            returns = sound_returns(sweep)
            if returns is None:
                continue
            image = min(scene.frames, key=lambda frame: abs(frame.timestamp - sweep.timestamp))
            points = apply(inverse(image.ego_to_world) @ sweep.sensor_to_world, returns.points)
            distances = np.linalg.norm(points[:, :2], axis=1)
            around = (distances > GROUND_RING[0]) & (distances < GROUND_RING[1])
            near += int((np.abs(points[around, 2]) < GROUND_HEIGHT).sum())
            total += int(around.sum())
        if total and near / total < MIN_GROUND:
            found.append(
                f"LiDAR {lidar}: hardly any return lies near the ground (z = 0 of the ego frame): check its "
                "sensor_to_ego, the rotations of ego_poses, and that points of sweeps are in the sensor's frame, "
                "not in the world"
            )
    for camera in dict.fromkeys(frame.camera for frame in scene.frames) if any(by_lidar.values()) else ():
        frames = _spread(_frames_of(scene, camera))
        if not any(_seen(frame, sweeps) for frame in frames for sweeps in by_lidar.values() if sweeps):
            found.append(
                f"camera {camera}: no return of a LiDAR falls into its images: check its sensor_to_ego (x right, y "
                "down, z forward, in metres) and that of the LiDAR"
            )
    return found


def _seen(frame: Frame, sweeps: list[Sweep]) -> bool:
    """Whether a return of the sweep nearest in time falls into an image, or its file cannot be read."""
    sweep = min(sweeps, key=lambda sweep: abs(sweep.timestamp - frame.timestamp))
    returns = sound_returns(sweep)
    if returns is None:
        return True
    points = apply(sweep.sensor_to_world, returns.points)
    size = (frame.width, frame.height)
    pixels, depth = project(points, inverse(frame.camera_to_world), continuous_intrinsics(frame, size))
    return bool(((depth > 0.5) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)).any())


def _frames_of(scene: Scene, camera: str) -> list[Frame]:
    return sorted((frame for frame in scene.frames if frame.camera == camera), key=lambda frame: frame.timestamp)


def _spread(items: list[T]) -> list[T]:
    """At most SAMPLED_SWEEPS of some items, from the first to the last."""
    chosen = np.unique(np.linspace(0, len(items) - 1, SAMPLED_SWEEPS).round().astype(int)) if items else []
    return [items[i] for i in chosen]
