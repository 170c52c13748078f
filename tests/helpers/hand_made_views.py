"""Drives past points that are known: scenes without images, and a pycolmap database of what their cameras see."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.features import image_pairs, write_images
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.refine_poses import RefinePosesJob

KEY_FRAME_US = 500_000
SIZE = (800, 450)
LOOKS_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The rotation of an OpenCV camera that looks along the car's x."""
HEADINGS = {
    "CAM_FRONT": 0.0, "CAM_FRONT_RIGHT": -55.0, "CAM_BACK_RIGHT": -110.0, "CAM_BACK": 180.0, "CAM_BACK_LEFT": 110.0,
    "CAM_FRONT_LEFT": 55.0,
}  # fmt: skip
"""nuScenes' cameras, in degrees to the left."""
FIELDS = {name: 110.0 if name == "CAM_BACK" else 70.0 for name in HEADINGS}
"""Their horizontal fields of view, in degrees."""
DELAYS_US = dict(zip(HEADINGS, (-35_000, -26_000, -18_000, -9_000, -44_000, -40_000), strict=True))
"""When they fire, from the key frame's LiDAR on."""
FRONT = ("CAM_FRONT",)
FEATURE_NOISE = 0.3


def ego_at(seconds: float) -> np.ndarray:
    """The true pose (4, 4): 8 m/s along a street that bends a little to the left and rises."""
    heading = 0.02 * seconds
    place = np.array([8.0 * seconds, 0.08 * seconds**2, 0.15 * np.sin(0.8 * seconds)])
    return rigid(Rotation.from_euler("zyx", [heading, 0.0, 0.0]).as_matrix(), place)


def error_at(seconds: float) -> np.ndarray:
    """What is wrong with recorded poses of nuScenes' kind (4, 4), in the car's frame, its height aside: roll and pitch
    by half a degree and more, centimetres."""
    waves = np.sin(2 * np.pi * seconds / np.array([7.0, 9.0, 6.0, 8.0]) + [0.3, 1.9, 4.0, 2.5])
    roll, pitch, ahead, left = waves * [0.6, 0.6, 0.03, 0.03] + [0.2, 0.4, 0.0, 0.0]
    return rigid(Rotation.from_euler("xy", [roll, pitch], degrees=True).as_matrix(), np.array([ahead, left, 0.0]))


def recorded(pose: np.ndarray, error: np.ndarray) -> np.ndarray:
    """A pose (4, 4) as tables state it: turned and moved by `error`, and flat."""
    result = pose @ error
    result[2, 3] = 0.0
    return result


def street_points(count: int) -> np.ndarray:
    """Points (n, 3) of houses on both sides of the way, and of the ground."""
    rng = np.random.default_rng(0)
    along = rng.uniform(-40.0, 110.0, count)
    side = np.where(rng.uniform(size=count) < 0.5, -1.0, 1.0) * rng.uniform(6.0, 20.0, count)
    height = np.where(rng.uniform(size=count) < 0.25, 0.0, rng.uniform(0.0, 9.0, count))
    return np.stack([along, side + 0.08 * (along / 8.0) ** 2, height], axis=1)


@dataclass(frozen=True)
class Drive:
    """A scene with the poses that tables state, and the true ego_to_world (n, 4, 4) of its frames."""

    scene: Scene
    truth: np.ndarray


def drive_of(
    key_frames: int = 12, cameras: Sequence[str] = FRONT, ego_path=ego_at, error=error_at,
    size: tuple[int, int] = SIZE, **fields,
) -> Drive:  # fmt: skip
    """A drive of nuScenes' rig; `way` and `error` give poses at seconds, `fields` what else the scene holds."""
    frames, truth = [], []
    for index in range(key_frames):
        for camera in cameras:
            timestamp = index * KEY_FRAME_US + DELAYS_US[camera] + 100_000
            pose = ego_path(timestamp * 1e-6)
            given = recorded(pose, error(timestamp * 1e-6))
            frames.append(_frame(camera, timestamp, given, index, size))
            truth.append(pose)
    times = np.arange(key_frames) * KEY_FRAME_US + 100_000
    whole = {
        "name": "made", "dataset": "made", "version": "none", "description": "", "origin": np.zeros(3),
        "key_frame_timestamps": times, "frames": tuple(frames), "sweeps": (), "tracks": (), "poses": "nuscenes",
        "key_frame_hz": 2.0,
    }  # fmt: skip
    return Drive(Scene(**{**whole, **fields}), np.stack(truth))


def _frame(camera: str, timestamp: int, ego_to_world: np.ndarray, index: int, size: tuple[int, int]) -> Frame:
    focal = size[0] / 2 / np.tan(np.radians(FIELDS[camera] / 2))
    k = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
    turn = Rotation.from_euler("z", HEADINGS[camera], degrees=True).as_matrix()
    mount = rigid(turn @ LOOKS_FORWARD, turn @ np.array([0.8, 0.0, 0.0]) + np.array([0.8, 0.0, 1.5]))
    return Frame(
        camera, timestamp, f"{camera}/{index}.jpg", *size, k, ego_to_world @ mount, ego_to_world, True, index,
        f"{camera} {index}",
    )  # fmt: skip


@dataclass(frozen=True)
class Seen:
    """What an image shows: which of the points (m,), and where (m, 2), in continuous pixels."""

    points: np.ndarray
    pixels: np.ndarray


def views(
    drive: Drive, images: RigImages, points: np.ndarray, noise: float = FEATURE_NOISE, seed: int = 1
) -> list[Seen]:
    """What every image shows of `points` (p, 3) from its true pose, up to 60 m away, found with an error of `noise`
    pixels."""
    rng = np.random.default_rng(seed)
    seen = []
    for index, frame in zip(images.indices, images.frames, strict=True):
        mount = inverse(frame.ego_to_world) @ frame.camera_to_world
        size = (frame.width, frame.height)
        pixels, depth = project(points, inverse(drive.truth[index] @ mount), continuous_intrinsics(frame, size))
        shown = np.flatnonzero((depth > 2.0) & (depth < 60.0) & ((pixels > 0) & (pixels < size)).all(axis=1))
        seen.append(Seen(shown, pixels[shown] + rng.normal(0.0, noise, (len(shown), 2))))
    return seen


def write_database(
    path: Path, images: RigImages, seen: Sequence[Seen], job: RefinePosesJob, wrong: float = 0.0
) -> pycolmap.Reconstruction:
    """A database of features and matches as the stage's own; `wrong` of the matches join what is not the same."""
    rng = np.random.default_rng(2)
    keypoints = [np.column_stack([s.pixels, np.ones(len(s.pixels)), np.zeros(len(s.pixels))]) for s in seen]
    none = np.zeros((0, 128), dtype=np.uint8)
    reconstruction = write_images(images, ((k.astype(np.float32), none) for k in keypoints), path)
    database = pycolmap.Database.open(path)
    for a, b in image_pairs(images, job.refine_poses.paired_features):
        _, first, second = np.intersect1d(seen[a - 1].points, seen[b - 1].points, return_indices=True)
        matches = np.stack([first, second], axis=1)
        mixed = rng.uniform(size=len(matches)) < wrong
        matches[mixed, 1] = rng.permutation(matches[mixed, 1])
        geometry = pycolmap.TwoViewGeometry(
            config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=matches.astype(np.uint32)
        )
        database.write_matches(a, b, matches.astype(np.uint32))
        database.write_two_view_geometry(a, b, geometry)
    database.close()
    return reconstruction


def job_of(**settings) -> RefinePosesJob:
    return RefinePosesJob.model_validate({"refine_poses": settings, "random_seed": 0})
