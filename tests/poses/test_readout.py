"""The refinement of poses with a rolling shutter: features are moved to where they are at the image's timestamp."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from helpers.hand_made_views import FRONT, SIZE, Drive, Seen, drive_of, job_of, street_points, write_database
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.readout import at_timestamp
from drivesplat.preprocess.poses.refine import refine_from_matches
from drivesplat.preprocess.poses.refinement_record import Refinement
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.recorded_shutters import shutters
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene
from drivesplat.scene.sensors import Camera

READOUT_S = 0.05
KEY_FRAMES = 10


def winding(seconds: float) -> np.ndarray:
    """The true pose (4, 4): 8 m/s, turning to the left and to the right by 15 degrees a second, rocking a little."""
    heading = 0.3 * np.sin(0.9 * seconds)
    turn = Rotation.from_euler("zy", [heading, 0.01 * np.sin(2.0 * seconds)]).as_matrix()
    return rigid(turn, np.array([8.0 * seconds, -0.9 * np.cos(0.9 * seconds), 0.0]))


def rolling_drive(readout_s: float | None = READOUT_S) -> Drive:
    """The winding drive with its true poses, and a camera that states its readout."""
    camera = Camera("CAM_FRONT", *SIZE, np.eye(3), readout_s=readout_s, readout_direction="down")
    drive = drive_of(KEY_FRAMES, FRONT, ego_path=winding, error=lambda _: np.eye(4))
    return dataclasses.replace(drive, scene=dataclasses.replace(drive.scene, cameras=(camera,)))


def seen_line_by_line(drive: Drive, points: np.ndarray, noise: float = 0.1) -> list[Seen]:
    """What the images show of `points` (p, 3): each at the time when its own line is read, along the true path."""
    random, seen = np.random.default_rng(1), []
    for frame in drive.scene.frames:
        mount, k = inverse(frame.ego_to_world) @ frame.camera_to_world, continuous_intrinsics(frame, SIZE)
        found = np.full((len(points), 2), np.nan)
        for i, point in enumerate(points):
            seconds = 0.0
            for _ in range(8):
                pose = winding(frame.timestamp * 1e-6 + seconds) @ mount
                pixel, depth = project(point[None], inverse(pose), k)
                if not 2.0 < depth[0] < 60.0:
                    break
                seconds = READOUT_S * (np.clip(pixel[0, 1], 0, SIZE[1]) / SIZE[1] - 0.5)
            else:
                found[i] = pixel[0]
        shown = np.flatnonzero((np.nan_to_num(found, nan=-1.0) > 0).all(axis=1) & (found < SIZE).all(axis=1))
        seen.append(Seen(shown, found[shown] + random.normal(0.0, noise, (len(shown), 2))))
    return seen


@pytest.fixture(scope="module")
def views() -> list[Seen]:
    return seen_line_by_line(rolling_drive(), street_points(300))


def images_of(scene: Scene) -> RigImages:
    return RigImages.of(scene, range(len(scene.frames)))


def refined(folder, drive: Drive, views: list[Seen]) -> Refinement:
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR
    images, database = images_of(drive.scene), folder / "features.db"
    start = write_database(database, images, views, job_of())
    return refine_from_matches(images, start, database, job_of(), 1)


def test_features_lie_where_a_global_shutter_sees_them():
    """Within a tenth of what the shutter moves them."""
    drive, points = rolling_drive(), street_points(300)
    views = seen_line_by_line(drive, points, noise=0.0)
    moved = []
    for frame, shutter, view in zip(drive.scene.frames, shutters(drive.scene), views, strict=True):
        k = continuous_intrinsics(frame, SIZE)
        truth, depths = project(points[view.points], inverse(frame.camera_to_world), k)
        found = at_timestamp(view.pixels, depths, shutter, k, SIZE)
        moved.append(np.linalg.norm([view.pixels - truth, found - truth], axis=2))
    before, after = np.concatenate(moved, axis=1)
    assert np.quantile(before, 0.9) > 1.5
    assert np.median(after) < 0.1 * np.median(before) and np.quantile(after, 0.9) < 0.1 * np.quantile(before, 0.9)


def test_true_poses_are_kept_which_a_global_shutter_would_turn(tmp_path, views):
    (tmp_path / "known").mkdir(), (tmp_path / "unknown").mkdir()
    known = refined(tmp_path / "known", rolling_drive(), views).record
    unknown = refined(tmp_path / "unknown", rolling_drive(None), views).record
    assert not known["refined"]
    assert known["reprojection_px"] < 0.8 * unknown["reprojection_px"]
    assert known["turn_deg"]["median"] < 0.4 * unknown["turn_deg"]["median"]
