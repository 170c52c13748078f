"""Poses from images alone: synthetic matches with known poses, and drives that do not determine their poses."""

import dataclasses
import json
import logging
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers import drives
from helpers.hand_made_views import FRONT, Drive, Seen, drive_of, error_at, views, write_database
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.preprocess.poses.from_images import align_poses
from drivesplat.preprocess.poses.mapping import MappingProgress
from drivesplat.preprocess.poses.refine import estimate_from_matches
from drivesplat.preprocess.poses.refinement_record import Refinement
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.readers.drive.reader import read
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scene import Scene, Sweep
from drivesplat.settings.refine_poses import PriorSettings, RefinePosesJob

pytestmark = pytest.mark.usefixtures("quiet")
LIDAR = rigid(np.eye(3), np.array([0.9, 0.0, 1.8]))
RAYS = {"ray_spacing": [0.33, 1.33], "own_car_radius": 2.5}


@pytest.fixture(scope="module")
def quiet():
    before, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, pycolmap.logging.FATAL
    yield
    pycolmap.logging.minloglevel = before


def curve(seconds: float) -> np.ndarray:
    """The true pose (4, 4) at 8 m/s on a circle with a radius of 100 m."""
    heading = 0.08 * seconds
    place = 100.0 * np.array([np.sin(heading), 1.0 - np.cos(heading), 0.0])
    return rigid(Rotation.from_euler("z", heading).as_matrix(), place)


def nowhere(ego_path):
    """The error that makes every recorded pose the identity."""
    return lambda seconds: inverse(ego_path(seconds))


def points_along(ego_path, count: int = 700, seconds: float = 12.0) -> np.ndarray:
    """Points (n, 3) on both sides of a way, and before its end."""
    rng = np.random.default_rng(0)
    side = np.where(rng.uniform(size=count) < 0.5, -1.0, 1.0) * rng.uniform(5.0, 18.0, count)
    beside = np.stack([np.zeros(count), side, rng.uniform(0.0, 8.0, count)], axis=1)
    return np.stack(
        [apply(ego_path(t), p[None])[0] for t, p in zip(rng.uniform(-1.0, seconds, count), beside, strict=True)]
    )


@dataclasses.dataclass(frozen=True)
class Case:
    drive: Drive
    images: RigImages
    database: Path
    start: pycolmap.Reconstruction

    def made(self, threads: int = 1, lidar: bool = True, **settings) -> Refinement:
        return estimate_from_matches(self.images, self.start, self.database, job_of(lidar, **settings), threads)


def job_of(lidar: bool = True, **settings) -> RefinePosesJob:
    fields = {"refine_poses": {"start": "images", **settings}, "random_seed": 0, "lidar": RAYS if lidar else None}
    return RefinePosesJob.model_validate(fields)


def case_of(
    folder: Path, ego_path=curve, error=None, key_frames: int = 10, points=None, shows=None, noise=0.0, stretch=None,
    cameras=FRONT,
) -> Case:  # fmt: skip
    """A drive of cameras and LiDAR, by default with no recorded poses. `shows`: which of the points image i may show.
    `stretch`: a factor on what LiDAR measures, by key frame."""
    drive = drive_of(key_frames, cameras, ego_path, error or nowhere(ego_path))
    points = points_along(ego_path) if points is None else points
    scene = dataclasses.replace(drive.scene, sweeps=sweeps_of(folder, drive.scene, ego_path, error, points, stretch))
    drive = Drive(scene, drive.truth)
    images = RigImages.of(scene, range(len(scene.frames)))
    seen = views(drive, images, points, noise)
    for i, view in enumerate(seen if shows else ()):
        kept = shows(i, view.points)
        seen[i] = Seen(view.points[kept], view.pixels[kept])
    start = write_database(folder / "features.db", images, seen, job_of())
    return Case(drive, images, folder / "features.db", start)


def sweeps_of(folder: Path, scene: Scene, ego_path, error, points, stretch) -> tuple[Sweep, ...]:
    """A sweep a key frame that meets all points, its pose as recorded."""
    sweeps = []
    for i, time in enumerate(scene.key_frame_timestamps):
        pose, path = ego_path(time * 1e-6), folder / f"{i}.pcd.bin"
        returns = np.zeros((len(points), 5), dtype=np.float32)
        returns[:, :3] = apply(inverse(pose @ LIDAR), points) * (stretch(i) if stretch else 1.0)
        returns.tofile(path)
        recorded = pose @ (error or nowhere(ego_path))(time * 1e-6)
        sweeps.append(Sweep(str(path), int(time), recorded @ LIDAR, True, i, str(i), "LIDAR_TOP", "nuscenes"))
    return tuple(sweeps)


def poses_of(refined: Refinement) -> np.ndarray:
    return np.stack([frame.ego_to_world for frame in refined.scene.frames])


def apart(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """How far two drives (n, 4, 4) lie apart at most, in metres and degrees."""
    change = inverse(a) @ b
    turns = Rotation.from_matrix(change[:, :3, :3]).magnitude()
    return float(np.linalg.norm(change[:, :3, 3], axis=1).max()), float(np.degrees(turns).max())


@pytest.fixture(scope="module")
def unlocated(tmp_path_factory) -> Case:
    return case_of(tmp_path_factory.mktemp("unlocated"))


@pytest.fixture(scope="module")
def unlocated_made(unlocated) -> Refinement:
    return unlocated.made()


def test_a_drive_without_recorded_poses_is_recovered_in_metres(unlocated, unlocated_made):
    """All recorded poses are the identity: the first image keeps it, LiDAR gives the scale."""
    truth = unlocated.drive.truth
    assert apart(inverse(truth[0]) @ truth, poses_of(unlocated_made))[0] < 0.02
    assert apart(inverse(truth[0]) @ truth, poses_of(unlocated_made))[1] < 0.005
    assert unlocated_made.scene.poses == "images"
    np.testing.assert_allclose(poses_of(unlocated_made)[0], np.eye(4), atol=0.01)


def write_unposed(folder: Path, case: Case) -> Path:
    """The drive of a case as a drive folder without any pose."""
    scene = case.drive.scene
    k = np.array(scene.frames[0].intrinsics)
    identity = {"translation": [0.0, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]}
    mount = inverse(scene.frames[0].ego_to_world) @ scene.frames[0].camera_to_world
    sweeps = []
    for sweep in scene.sweeps:
        returns = np.fromfile(sweep.path, dtype=np.float32).reshape(-1, 5)
        np.savez(folder / f"{sweep.token}.npz", **dict(zip("xyz", returns.T[:3], strict=True)))
        sweeps.append({"lidar": "top", "timestamp": sweep.timestamp, "file": f"{sweep.token}.npz"})
    camera = {"width": scene.frames[0].width, "height": scene.frames[0].height, "K": k.tolist()}
    camera["sensor_to_ego"] = {"translation": mount[:3, 3].tolist(), "rotation": mount[:3, :3].tolist()}
    record = {
        "format": "drivesplat drive",
        "version": 1,
        "cameras": {"CAM_FRONT": camera},
        "lidars": {"top": {"sensor_to_ego": {**identity, "translation": LIDAR[:3, 3].tolist()}}},
        "frames": [{"camera": f.camera, "timestamp": f.timestamp, "file": f"{f.token}.jpg"} for f in scene.frames],
        "sweeps": sweeps,
    }
    (folder / "drive.json").write_text(json.dumps(record), encoding="utf-8")
    return folder


def test_a_drive_folder_without_poses_is_recovered_in_metres(unlocated, tmp_path):
    """Read with its poses to be estimated, it gets those of a drive whose recorded poses are the identity."""
    source = drives.source(dataset="mine", reader="drive", version="", scene="it", sweeps=False, poses_from_images=True)
    scene = read(write_unposed(tmp_path, unlocated), source)
    assert scene.poses == "none"
    np.testing.assert_array_equal([frame.ego_to_world for frame in scene.frames], [np.eye(4)] * 10)
    images = RigImages.of(scene, range(10))
    made = estimate_from_matches(images, unlocated.start, unlocated.database, job_of(), 1)
    truth = unlocated.drive.truth
    metres, degrees = apart(inverse(truth[0]) @ truth, poses_of(made))
    assert metres < 0.02 and degrees < 0.005
    assert made.scene.poses == "images" and made.record["placement"]["scale_from"] == "LiDAR"
    for sweep in made.scene.sweeps:
        expected = inverse(truth[0]) @ curve(sweep.timestamp * 1e-6) @ LIDAR
        np.testing.assert_allclose(sweep.sensor_to_world, expected, atol=0.03)


def test_its_points_lie_at_true_positions(unlocated, unlocated_made):
    """They lie where the truth has them, as seen from the first image."""
    truth = apply(inverse(unlocated.drive.truth[0]), points_along(curve))
    found = unlocated_made.points.points
    assert len(found) > 200 and set(unlocated_made.points.seen_by) == set(range(10))
    assert np.median(np.linalg.norm(found[:, None] - truth, axis=2).min(axis=1)) < 0.04


def test_sweeps_take_interpolated_poses(unlocated, unlocated_made):
    """A sweep lies where the car was at its time, between two images, or a little after the last one."""
    first = unlocated.drive.truth[0]
    for sweep in unlocated_made.scene.sweeps:
        expected = inverse(first) @ curve(sweep.timestamp * 1e-6) @ LIDAR
        assert apart(expected[None], sweep.sensor_to_world[None])[0] < 0.05


def test_two_runs_agree_whatever_the_threads(unlocated, unlocated_made):
    for threads in (1, 2):
        again = unlocated.made(threads)
        np.testing.assert_allclose(poses_of(again), poses_of(unlocated_made), atol=1e-9 if threads == 1 else 1e-3)


def test_estimated_poses_are_aligned_to_recorded_poses_that_move(tmp_path):
    """They are as noisy as nuScenes' poses; only their best fit is used."""
    case = case_of(tmp_path, error=error_at, noise=0.1)
    made, truth = case.made(), case.drive.truth
    place, turn = apart(truth, poses_of(made))
    assert place < 0.3 and turn < 1.0 and made.record["placement"]["aligned_to"] == "recorded poses"
    best = align_poses(truth, poses_of(made), PriorSettings())
    assert apart(truth, best)[0] < 0.05 and apart(truth, best)[1] < 0.1
    reported = [made.record[key]["median"] for key in ("shift_m", "turn_deg")]
    recorded = np.stack([frame.ego_to_world for frame in case.drive.scene.frames])
    change = inverse(recorded) @ poses_of(made)
    angles = np.degrees(Rotation.from_matrix(change[:, :3, :3]).magnitude())
    assert reported == pytest.approx([np.median(np.linalg.norm(change[:, :3, 3], axis=1)), np.median(angles)], rel=1e-3)


def stands(seconds: float) -> np.ndarray:
    return np.eye(4)


def turns_on_the_spot(seconds: float) -> np.ndarray:
    """About the front camera, which stays where it is."""
    camera = rigid(np.eye(3), np.array([1.6, 0.0, 1.5]))
    return camera @ rigid(Rotation.from_euler("z", 0.1 * seconds).as_matrix(), np.zeros(3)) @ inverse(camera)


@pytest.mark.parametrize("ego_path", [stands, turns_on_the_spot])
def test_a_vehicle_without_translation_is_refused(tmp_path, ego_path):
    case = case_of(tmp_path, ego_path, noise=0.3, points=points_along(curve, 400, 5.0))
    with pytest.raises(DatasetError, match=r"scene made: .*far enough apart, as where the vehicle.*start: recorded"):
        case.made()


def test_unplaced_images_are_interpolated(tmp_path):
    case = case_of(tmp_path, shows=lambda i, points: np.full(len(points), i not in (4, 5)))
    made = case.made()
    assert made.record["placement"]["images_placed"] == 8
    assert [item["points"] for item in made.record["corrections"]][4:6] == [0, 0]
    poses = poses_of(made)
    headings = np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    np.testing.assert_allclose(np.diff(headings)[3:6], np.degrees(0.04), atol=0.01)
    thirds = poses[3, :3, 3] + np.array([[1 / 3], [2 / 3]]) * (poses[6, :3, 3] - poses[3, :3, 3])
    np.testing.assert_allclose(poses[4:6, :3, 3], thirds, atol=1e-6)


@pytest.mark.slow
def test_scale_drift_is_followed_up_to_a_limit(tmp_path):
    """LiDAR finds all things 4 % farther off at every key frame, as if the images' scale shrank."""
    case = case_of(tmp_path, stretch=lambda i: 1.04**i)
    with pytest.raises(DatasetError, match=r"LiDAR, the scale changes by a factor of 1\.\d\d .*drift.*recorded"):
        case.made(limits={"max_scale_drift": 1.1})
    made = case.made(limits={"max_scale_drift": 2.0})
    assert 1.15 < made.record["placement"]["scale_drift"] < 1.45


def test_a_misplaced_image_is_interpolated(tmp_path):
    """LiDAR halves the distances of the last image: it is left out, and the adjustment corrects it."""
    case = case_of(tmp_path, stretch=lambda i: 0.5 if i == 9 else 1.0)
    made, truth = case.made(), case.drive.truth
    assert made.record["placement"]["images_placed"] == 9 and made.record["placement"]["models"] == [10]
    assert apart(inverse(truth[0]) @ truth, poses_of(made))[0] < 0.15
    with pytest.raises(DatasetError, match=r"LiDAR, 1 of 10 images are misplaced \(min_images\), .*start: recorded"):
        case.made(limits={"min_images": 0.95})


def test_progress_of_the_mapper_is_logged_with_the_time_left(caplog):
    """A clock that advances 4 s at each call: one image takes 4 s, and a line is written every 12 s."""
    times = iter(range(0, 1000, 4))
    progress = MappingProgress("CAM_FRONT", 20, lambda: float(next(times)))
    with caplog.at_level(logging.INFO):
        progress.begin_model()
        for _ in range(6):
            progress.add_image()
    assert [record.message for record in caplog.records] == [
        "camera CAM_FRONT: model 1 begins, 20 images",
        "camera CAM_FRONT: model 1, 4 of 20 images placed, about 64 s left",
        "camera CAM_FRONT: model 1, 7 of 20 images placed, about 52 s left",
    ]
