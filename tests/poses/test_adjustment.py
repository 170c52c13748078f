"""Triangulation and bundle adjustment on synthetic matches with known poses and points."""

import dataclasses
from pathlib import Path

import numpy as np
import pyceres
import pycolmap
import pytest
from helpers.hand_made_views import (
    HEADINGS,
    Drive,
    Seen,
    drive_of,
    ego_at,
    job_of,
    street_points,
    views,
    write_database,
)  # fmt: skip
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.adjustment import (
    Priors,
    bundle_adjust,
    observations_of,
    priors_of,
    triangulate,
    with_poses,
)
from drivesplat.preprocess.poses.from_matches import MatchJudge
from drivesplat.preprocess.poses.from_sweeps import SweepJudge
from drivesplat.preprocess.poses.refine import poses_of, refine_from_matches
from drivesplat.preprocess.poses.refinement_record import Refinement
from drivesplat.preprocess.poses.rig import RigImages, from_pycolmap, sensor, to_pycolmap
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene, Sweep
from drivesplat.settings.refine_poses import PriorSettings

pytestmark = pytest.mark.usefixtures("quiet")


@pytest.fixture(scope="module")
def quiet():
    before, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, pycolmap.logging.ERROR
    yield
    pycolmap.logging.minloglevel = before


@dataclasses.dataclass(frozen=True)
class Case:
    """A drive whose images' features lie in a database, and `start`: them with the given poses."""

    drive: Drive
    images: RigImages
    database: Path
    start: pycolmap.Reconstruction

    def refined(self, threads: int = 1, **settings) -> Refinement:
        return refine_from_matches(self.images, self.start, self.database, job_of(**settings), threads)

    def wobble(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        """How much what is wrong with a scene's poses changes: standard deviations over the images of the rotation (3,)
        in degrees and the position (3,) in metres, in the car's frame, beside a steady growth: a constant tilt, and the
        climb that goes with it, are left to the priors."""
        poses = np.stack([scene.frames[i].ego_to_world for i in self.images.indices])
        errors = inverse(self.drive.truth[list(self.images.indices)]) @ poses
        turns = Rotation.from_matrix(errors[:, :3, :3]).as_rotvec(degrees=True)
        steady = np.stack([np.ones(len(errors)), self.images.seconds], axis=1)
        places = errors[:, :3, 3] - steady @ np.linalg.lstsq(steady, errors[:, :3, 3], rcond=None)[0]
        return turns.std(axis=0), places.std(axis=0)


def case_of(folder: Path, drive: Drive, points: int = 400, wrong: float = 0.0, without=(), **view) -> Case:
    """`without`: images (by their order) that show nothing."""
    images = RigImages.of(drive.scene, range(len(drive.scene.frames)))
    seen = views(drive, images, street_points(points), **view)
    for i in without:
        seen[i] = Seen(seen[i].points[:0], seen[i].pixels[:0])
    start = write_database(folder / "features.db", images, seen, job_of(), wrong)
    return Case(drive, images, folder / "features.db", start)


@pytest.fixture(scope="module")
def front(tmp_path_factory) -> Case:
    return case_of(tmp_path_factory.mktemp("front"), drive_of(10))


@pytest.fixture(scope="module")
def front_refined(front) -> Refinement:
    return front.refined()


def test_tilts_and_heights_of_one_camera_are_recovered(front, front_refined):
    assert front_refined.record["refined"]
    (tilt, place), (given_tilt, given_place) = front.wobble(front_refined.scene), front.wobble(front.drive.scene)
    assert (given_tilt[:2] > 0.25).all() and given_place[2] > 0.05, "the case has something to recover"
    assert (tilt[:2] < 0.1 * given_tilt[:2]).all()
    assert place[2] < 0.15 * given_place[2] and (place[:2] < 0.75 * given_place[:2]).all() and tilt[2] < 0.02


def test_six_cameras_are_one_rig(tmp_path):
    case = case_of(tmp_path, drive_of(5, tuple(HEADINGS)), points=800)
    refined = case.refined(rounds=2)
    assert refined.record["images"] == 30 and refined.record["refined"]
    (tilt, place), (given_tilt, given_place) = case.wobble(refined.scene), case.wobble(case.drive.scene)
    assert (tilt[:2] < 0.15 * given_tilt[:2]).all() and place[2] < 0.2 * given_place[2] and tilt[2] < 0.02
    for before, after in zip(case.drive.scene.frames, refined.scene.frames, strict=True):
        mounts = [inverse(frame.ego_to_world) @ frame.camera_to_world for frame in (before, after)]
        np.testing.assert_allclose(mounts[1], mounts[0], atol=1e-9)
        np.testing.assert_array_equal(after.intrinsics, before.intrinsics)


def test_points_come_to_lie_where_they_are_and_errors_fall_to_the_features_noise(front, tmp_path):
    """The median of an error with deviation s in x and y is 1.18 s; points follow their features a little."""
    case = case_of(tmp_path, drive_of(10, ego_path=flat, error=lambda _: np.eye(4)), noise=0.3)
    reconstruction = triangulate(case.start, case.database, job_of(), 1)
    seen = observations_of(reconstruction)
    truth = street_points(400)
    nearest = np.linalg.norm(seen.positions[:, None] - truth, axis=2).min(axis=1)
    assert len(seen.positions) > 100 and np.median(nearest) < 0.3
    assert 0.2 < np.median(seen.error) < 0.36
    given = triangulate(front.start, front.database, job_of(), 1)
    assert np.median(observations_of(given).error) > 3 * np.median(seen.error)


def flat(seconds: float) -> np.ndarray:
    pose = ego_at(seconds)
    pose[2, 3] = 0.0
    return pose


def test_pycolmap_sees_points_where_the_library_projects_them(front):
    """Camera frames, intrinsics and the pixel convention are the same on both sides."""
    images, truth = front.images, street_points(400)
    reconstruction = with_poses(front.start, front.drive.truth[list(images.indices)])
    exact = views(front.drive, images, truth, noise=0.0)
    for number, seen in enumerate(exact, start=1):
        assert len(seen.points) > 30
        image = reconstruction.images[number]
        found = np.stack([image.project_point(truth[point]) for point in seen.points])
        np.testing.assert_allclose(found, seen.pixels, atol=1e-6)


def test_two_runs_agree_whatever_the_threads(front, front_refined):
    again = front.refined(threads=3)
    assert again.record["points"] == front_refined.record["points"]
    for a, b in zip(front_refined.scene.frames, again.scene.frames, strict=True):
        np.testing.assert_allclose(a.camera_to_world, b.camera_to_world, atol=1e-6)
    np.testing.assert_allclose(again.points.points, front_refined.points.points, atol=1e-6)


def test_wrong_matches_are_rejected(tmp_path, front):
    """A fifth of all matches join what is not the same."""
    case = case_of(tmp_path, front.drive, wrong=0.2)
    tilt, _ = case.wobble(case.refined().scene)
    assert (tilt[:2] < 0.12 * case.wobble(front.drive.scene)[0][:2]).all()


def test_the_robust_loss_downweights_outliers(tmp_path, front):
    """Errors that are small enough to pass for the same point; without a robust loss they turn the poses."""
    images, job = front.images, job_of()
    seen, rng = views(front.drive, images, street_points(400)), np.random.default_rng(5)
    for i, view in enumerate(seen):
        off = rng.uniform(size=len(view.points)) < 0.2
        seen[i] = Seen(view.points, view.pixels + off[:, None] * np.array([0.0, 6.0]))
    start = write_database(tmp_path / "features.db", images, seen, job)
    case = Case(front.drive, images, tmp_path / "features.db", start)
    robust, plain = (case.wobble(case.refined(rounds=2, robust_pixels=p).scene)[0][:2] for p in (1.0, 1000.0))
    assert (robust < 0.1).all() and np.linalg.norm(plain) > 2.0 * np.linalg.norm(robust)


def test_adjusting_leaves_cameras_and_their_mounts_as_calibrated(tmp_path):
    case = case_of(tmp_path, drive_of(4, ("CAM_FRONT", "CAM_FRONT_LEFT")), points=800)
    reconstruction = triangulate(case.start, case.database, job_of(), 1)
    bundle_adjust(reconstruction, priors_of(case.images, job_of().refine_poses), 1.0, 1)
    rig, made = case.images.rig(), reconstruction.rigs[1]
    for camera in case.images.pycolmap_cameras():
        mounts = (r.sensor_from_rig(sensor(camera.camera_id)).matrix() for r in (rig, made))
        np.testing.assert_array_equal(*mounts)
        np.testing.assert_array_equal(reconstruction.cameras[camera.camera_id].params, camera.params)


def test_the_absolute_prior_fixes_the_whole_drive(front):
    """Points and poses that are moved together fit as well as before: only the prior knows where they belong."""
    images = front.images
    given = priors_of(images, job_of().refine_poses)
    aside = with_poses(front.start, rigid(np.eye(3), np.array([0.5, -0.4, 0.3])) @ given.given)
    reconstruction = triangulate(aside, front.database, job_of(), 1)
    before = (poses_of(reconstruction) - given.given)[:, :3, 3].mean(axis=0)
    np.testing.assert_allclose(before, [0.5, -0.4, 0.3], atol=1e-6)
    bundle_adjust(reconstruction, given, 1.0, 1)
    assert np.linalg.norm((poses_of(reconstruction) - given.given)[:, :3, 3].mean(axis=0)) < 0.05


TURNED = rigid(Rotation.from_euler("zyx", [100.0, 5.0, -3.0], degrees=True).as_matrix(), np.array([30.0, -70.0, 2.0]))
"""A car that looks nearly along the world's y."""
SETTINGS = PriorSettings(position=0.05, height=0.1, tilt=0.02, heading=0.005, drift=0.25)
STANDS = rigid(TURNED[:3, :3], np.zeros(3))
DEVIATIONS = {"roll": 0.02, "pitch": 0.02, "yaw": 0.005, "ahead": 0.05, "left": 0.05, "up": 0.1}


def small(axis: str, size: float) -> np.ndarray:
    """A turn (radians) about, or a shift (metres) along, one of the car's axes."""
    vector = np.zeros(6)
    vector[list(DEVIATIONS).index(axis)] = size
    return rigid(Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:])


def parameters(pose: np.ndarray) -> np.ndarray:
    return np.array(to_pycolmap(inverse(pose)).params)


@pytest.mark.parametrize("axis", DEVIATIONS)
@pytest.mark.parametrize("seconds", [0.5, 2.0])
def test_a_pose_without_points_follows_its_neighbours(axis, seconds):
    """Between neighbours off by c, x minimises (x / s)^2 + 2 (x - c)^2 / (drift^2 s^2 t): x = c k / (1 + k) where k =
    2 / (drift^2 t). The car stands at the origin, so that turns move nothing."""
    times = seconds * np.arange(3)
    priors = Priors(np.stack([STANDS] * 3), times, SETTINGS, feature_noise=0.3)
    off = 0.2 * DEVIATIONS[axis]
    poses = {0: parameters(STANDS @ small(axis, off)), 1: parameters(STANDS), 2: parameters(STANDS @ small(axis, off))}
    problem = pyceres.Problem()
    priors.attach(problem, poses)
    for i in (0, 2):
        problem.set_parameter_block_constant(poses[i])
    options = pyceres.SolverOptions()
    options.function_tolerance = options.gradient_tolerance = options.parameter_tolerance = 1e-14
    pyceres.solve(options, problem, pyceres.SolverSummary())
    poses[1][:4] /= np.linalg.norm(poses[1][:4])
    middle = pycolmap.Rigid3d(pycolmap.Rotation3d(poses[1][:4]), poses[1][4:])
    change = inverse(STANDS) @ inverse(from_pycolmap(middle))
    found = np.concatenate([Rotation.from_matrix(change[:3, :3]).as_rotvec(), change[:3, 3]])
    k = 2 / (SETTINGS.drift**2 * seconds)
    expected = np.zeros(6)
    expected[list(DEVIATIONS).index(axis)] = off * k / (1 + k)
    np.testing.assert_allclose(found, expected, atol=1e-3 * off + 1e-9)


def test_images_of_equal_time_get_one_correction(tmp_path):
    """Cameras of some rigs fire together: both images get the same correction."""
    drive = drive_of(5, ("CAM_FRONT", "CAM_FRONT_LEFT"))
    together = tuple(
        dataclasses.replace(frame, timestamp=drive.scene.frames[i - i % 2].timestamp,
                            ego_to_world=drive.scene.frames[i - i % 2].ego_to_world,
                            camera_to_world=drive.scene.frames[i - i % 2].ego_to_world
                            @ inverse(frame.ego_to_world) @ frame.camera_to_world)
        for i, frame in enumerate(drive.scene.frames)
    )  # fmt: skip
    truth = drive.truth[[i - i % 2 for i in range(len(together))]]
    case = case_of(tmp_path, Drive(dataclasses.replace(drive.scene, frames=together), truth), points=300)
    refined = case.refined(rounds=1)
    assert refined.record["refined"]
    poses = [frame.ego_to_world for frame in refined.scene.frames]
    np.testing.assert_allclose(poses[0::2], poses[1::2], atol=1e-9)


@pytest.mark.parametrize(
    ("by_lidar", "by_matches", "cameras_move", "sweeps_move", "reason"),
    [
        (False, False, True, True, None),
        (True, False, True, False, None),
        (False, True, False, False, "matches"),
        (True, True, False, False, "matches"),
        (True, None, False, False, "surfaces"),
        (None, False, True, True, None),
        (None, True, False, False, "matches"),
    ],
)
def test_cameras_move_alone_where_lidar_alone_objects(
    front, by_lidar, by_matches, cameras_move, sweeps_move, reason, monkeypatch
):
    """`by_lidar`, `by_matches`: whether they find refined poses worse; None: there is no such judge."""
    sweep = Sweep("0.bin", front.drive.scene.frames[3].timestamp, ego_at(0.5), True, 0, "0", "LIDAR_TOP", "nuscenes")
    scene, judges = dataclasses.replace(front.drive.scene, sweeps=(sweep,)), []
    images = RigImages.of(scene, front.images.indices)
    for judge, worse in ((SweepJudge({}, []), by_lidar), (MatchJudge([]), by_matches)):
        after = 2.0 if worse else 0.5
        monkeypatch.setattr(type(judge), "distance", lambda _, it, after=after: 1.0 if it is scene else after)
        judges.append(None if worse is None else judge)
    job = job_of(priors_with_lidar=PriorSettings().model_dump(), limits={"max_stretch": 0.5})
    found = refine_from_matches(images, front.start, front.database, job, 1, *judges)
    for sensors, moves in (("frames", cameras_move), ("sweeps", sweeps_move)):
        assert (getattr(found.scene, sensors) is getattr(scene, sensors)) != moves, sensors
    record = found.record
    assert record["refined"] == cameras_move and found.scene.poses == ("refined" if cameras_move else scene.poses)
    assert (reason is None) == (record["images_kept_because"] is None) and (reason or "") in str(record["kept_because"])
    assert ("surfaces" in str(record["cameras_alone_because"])) == (cameras_move and not sweeps_move)
    assert set(record["judged"]) == {judge.name for judge in judges if judge}


@pytest.mark.parametrize(("by_lidar", "dropped"), [(True, True), (False, False)])
def test_cameras_move_alone_only_if_the_path_keeps_its_length(front, by_lidar, dropped, monkeypatch):
    after = 2.0 if by_lidar else 0.5
    monkeypatch.setattr(SweepJudge, "distance", lambda _, it: 1.0 if it is front.drive.scene else after)
    monkeypatch.setattr(MatchJudge, "distance", lambda _, it: 1.0 if it is front.drive.scene else 0.5)
    monkeypatch.setattr("drivesplat.preprocess.poses.refine.stretched", lambda *_: "the path is longer")
    job = job_of(priors_with_lidar=PriorSettings().model_dump())
    judges = SweepJudge({}, []), MatchJudge([])
    found = refine_from_matches(front.images, front.start, front.database, job, 1, *judges)
    assert (found.record["images_kept_because"] == "the path is longer") == dropped
    assert (found.scene.frames is front.drive.scene.frames) == dropped
