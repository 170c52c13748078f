"""What viewer.html knows of a drive beside its Gaussians: boxes of all tracks, and the split of the images."""

import json
import re

import numpy as np
import pytest
from helpers.hand_made import recording_of
from helpers.hand_made_traffic import TURNING
from scipy.spatial.transform import Rotation

from drivesplat.export.viewer_boxes import TOLERANCE, box_motions, needed_samples
from drivesplat.export.viewer_scene import box_records, recorded_path
from drivesplat.scene.rigid import rigid
from drivesplat.trajectories.motion import Motion


def interpolated(seconds: np.ndarray, poses: np.ndarray, at: float) -> np.ndarray:
    """As the page does it: entry by entry."""
    flat = poses.reshape(len(poses), 16)
    return np.array([np.interp(at, seconds, flat[:, k]) for k in range(16)]).reshape(4, 4)


def test_boxes_of_all_tracks_without_gaussians_follow_their_annotations(scene):
    """The scene has the turning track, which is a group here, and those of the tiny drive, which are not."""
    found = box_motions(scene, {TURNING})
    assert [box.track.id for box in found] == [track.id for track in scene.tracks if track.id != TURNING]
    assert found and TURNING in {box.track.id for box in box_motions(scene, ())}
    for box in found:
        motion = Motion.of_track(scene, box.track)
        assert box.spans[0][0] == motion.span[0] and box.spans[-1][1] == motion.span[1]
        for second in np.linspace(*motion.span, 23):
            if not motion.present(np.array([second]))[0]:
                continue
            pose = interpolated(box.seconds, box.object_to_world, second)
            corners = np.array([[x, y, z, 2.0] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2.0
            corners[:, :3] *= box.track.size
            moved = corners @ (pose - motion.poses(np.array([second]))[0]).T
            assert np.linalg.norm(moved[:, :3], axis=1).max() < TOLERANCE + 0.005


@pytest.mark.parametrize(("speed", "rate", "count"), [(0.0, 0.0, 2), (12.0, 0.0, 2), (5.0, 0.5, None)])
def test_samples_that_interpolation_replaces_are_left_out(speed, rate, count):
    """An object that stands or drives straight ahead needs two samples; one that turns needs some of 200."""
    seconds, size = np.linspace(0.0, 6.0, 200), np.array([4.0, 2.0, 1.5])
    turned = Rotation.from_euler("z", (rate * seconds)[:, None]).as_matrix()
    places = np.stack([speed * seconds, 0.2 * rate * seconds**2, np.ones(200)], axis=1)
    poses = rigid(turned, places)
    kept = needed_samples(seconds, poses, size)
    assert kept[0] == 0 and kept[-1] == 199 and (np.diff(kept) > 0).all()
    assert len(kept) == count if count else 5 < len(kept) < 60
    for second, pose in zip(seconds, poses, strict=True):
        moved = (interpolated(seconds[kept], poses[kept], second) - pose) @ np.array([*(size / 2.0), 1.0])
        assert np.linalg.norm(moved[:3]) <= TOLERANCE + 1e-9


def test_one_and_two_samples_are_kept():
    poses = np.tile(np.eye(4), (2, 1, 1))
    assert needed_samples(np.zeros(1), poses[:1], np.ones(3)).tolist() == [0]
    assert needed_samples(np.arange(2.0), poses, np.ones(3)).tolist() == [0, 1]


def test_records_of_boxes_name_their_rows(scene):
    boxes = box_motions(scene, ())
    records, rows = box_records(boxes)
    arrays = rows.arrays("box")
    for record, box in zip(records, boxes, strict=True):
        first, last = record["samples"]
        np.testing.assert_allclose(arrays["box_seconds"][first:last], box.seconds, atol=1e-6)
        np.testing.assert_allclose(arrays["box_poses"][first:last], box.object_to_world[:, :3], atol=1e-4)
        assert record["category"] == box.track.category and record["size"] == box.track.size.tolist()
    assert json.loads(json.dumps(records)) == records


def test_the_path_knows_the_held_out_times_and_the_last_training_image(tiny_scene):
    record = recording_of(tiny_scene, every_nth=4, offset=1, last_block=2).record
    path = recorded_path(tiny_scene, record, "CAM_FRONT")
    frames = sorted((f for f in tiny_scene.frames if f.camera == "CAM_FRONT"), key=lambda frame: frame.timestamp)
    key_frames = [tiny_scene.seconds(frame.timestamp) for frame in frames if frame.is_key_frame]
    assert path.first == frames[0] and list(path.key_frames) == key_frames
    assert path.held_out["extrapolation"] == key_frames[-2:]
    assert path.held_out["interpolation"] and set(path.held_out["interpolation"]) <= set(key_frames[:-2])
    trained = [int(record.timestamps[i]) for i in record.train_images if record.camera_name(i) == "CAM_FRONT"]
    assert path.last_training == tiny_scene.seconds(max(trained)) < key_frames[-2]


def test_without_a_training_image_of_its_own_the_last_one_of_all_cameras_counts(tiny_scene):
    record = recording_of(tiny_scene, last_block=2).record
    last = tiny_scene.seconds(max(int(record.timestamps[i]) for i in record.train_images))
    others = [*record.camera_names, "CAM_OTHER"]
    elsewhere = np.full_like(record.camera_indices, len(others) - 1)
    object.__setattr__(record, "camera_names", others)
    object.__setattr__(record, "camera_indices", elsewhere)
    path = recorded_path(tiny_scene, record, "CAM_FRONT")
    assert path.last_training == last and not any(path.held_out.values())
    assert not re.search("nan", json.dumps(path.held_out))
