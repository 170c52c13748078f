"""The smooth motion of an object: exact at its annotations, smooth between them, uniform beyond, absent in gaps."""

import numpy as np
import pytest
from helpers.classed import classed
from helpers.hand_made import about_z, motion_through
from scipy.spatial.transform import Rotation

from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import box_at
from drivesplat.trajectories.motion import Motion

TIMES = np.array([0.5, 1.0, 1.4, 2.0, 2.5, 3.1])
"""Seconds of annotations, not quite evenly spaced."""
REACH = 0.25


def winding() -> Motion:
    """Through positions and tilted rotations without any pattern."""
    rng = np.random.default_rng(0)
    turns = Rotation.from_euler("zyx", np.column_stack([np.linspace(0.0, 2.4, 6), rng.uniform(-0.4, 0.4, (6, 2))]))
    poses = np.stack([rigid(turn.as_matrix(), rng.uniform(-4, 4, 3)) for turn in turns])
    return Motion(TIMES, poses, ((0, 5),), REACH)


def local_polynomials(motion: Motion, time: float, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Value, speed, acceleration (3, 3) of the position at a time, and rate and acceleration (2, 3) of the rotation in
    the object's frame, from samples on one side (1.0: after it, -1.0: before it)."""
    steps = side * np.linspace(0.0, 0.08, 9)
    poses = motion.poses(time + steps)
    position = np.polynomial.polynomial.polyfit(steps, poses[:, :3, 3], 3)[:3]
    at = Rotation.from_matrix(poses[0, :3, :3])
    turned = (at.inv() * Rotation.from_matrix(poses[:, :3, :3])).as_rotvec()
    return position, np.polynomial.polynomial.polyfit(steps, turned, 7)[1:3]


def test_it_passes_through_every_annotation():
    motion = winding()
    np.testing.assert_allclose(motion.poses(TIMES), motion.object_to_world, atol=1e-12)
    np.testing.assert_allclose(motion.weights(TIMES), np.eye(6), atol=1e-12)


@pytest.mark.parametrize("time", [*TIMES[1:-1], 1.2, 2.7])
def test_velocity_and_acceleration_are_continuous(time):
    motion = winding()
    (position, turn), (position_after, turn_after) = (local_polynomials(motion, time, side) for side in (-1.0, 1.0))
    np.testing.assert_allclose(position, position_after, atol=1e-6)
    np.testing.assert_allclose(turn[0], turn_after[0], atol=1e-5)
    np.testing.assert_allclose(turn[1], turn_after[1], atol=1e-2)
    assert np.abs(position[2]).max() > 1.0 and np.abs(turn[1]).max() > 0.1, "there is an acceleration to be continuous"


def test_between_three_annotations_it_is_the_natural_cubic_spline():
    """Its second derivative at the middle knot of three, h apart, is 3 (a - 2 b + c) / 2 h²."""
    a, b, c, h = np.array([1.0, 2.0, 0.0]), np.array([4.0, -1.0, 0.5]), np.array([2.0, 3.0, 0.1]), 0.5
    motion = motion_through([0.0, h, 2 * h], [a, b, c])
    bend = 1.5 * (a - 2.0 * b + c) / h**2
    halfway = motion.poses(np.array([h / 2, 1.5 * h]))[:, :3, 3]
    np.testing.assert_allclose(halfway, [(a + b) / 2 - h**2 / 16 * bend, (b + c) / 2 - h**2 / 16 * bend], atol=1e-12)


@pytest.mark.parametrize("end", ["first", "last"])
def test_beyond_its_ends_velocity_and_turn_rate_are_constant(end):
    motion = winding()
    time, side = (TIMES[0], 1.0) if end == "first" else (TIMES[-1], -1.0)
    (place, speed, _), (rate, _) = local_polynomials(motion, time, side)
    rotation = motion.poses(np.array([time]))[0, :3, :3]
    for away in (0.05, 0.13, REACH):
        pose = motion.poses(np.array([time - side * away]))[0]
        np.testing.assert_allclose(pose[:3, 3], place - side * away * speed, atol=1e-6)
        expected = rotation @ Rotation.from_rotvec(-side * away * rate).as_matrix()
        np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-5)
    assert np.linalg.norm(speed) > 1.0 and np.linalg.norm(rate) > 0.3


@pytest.mark.parametrize("time", np.linspace(TIMES[0] - REACH, TIMES[-1] + REACH, 9))
def test_constant_velocity_and_turn_rate_are_reproduced_within_and_beyond(time):
    velocity, rate = np.array([3.0, -1.0, 0.2]), 0.8
    motion = motion_through(TIMES, TIMES[:, None] * velocity, rate * TIMES, reach=REACH)
    np.testing.assert_allclose(
        motion.poses(np.array([time]))[0], rigid(about_z(rate * time), time * velocity), atol=1e-9
    )


def with_a_gap() -> Motion:
    """Annotated at 0, 0.5, 1.0 and again at 2.5, 3.0 seconds, at another position."""
    places = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [20.0, 5.0, 0.0], [20.0, 6.0, 0.0]]
    return motion_through([0.0, 0.5, 1.0, 2.5, 3.0], places, [0.0, 0.0, 0.0, 1.5, 1.5], runs=((0, 2), (3, 4)))


@pytest.mark.parametrize(
    ("time", "present"),
    [(-0.26, False), (-0.25, True), (0.7, True), (1.25, True), (1.26, False), (1.75, False), (2.24, False),
     (2.25, True), (2.8, True), (3.25, True), (3.26, False)],
)  # fmt: skip
def test_it_is_absent_in_a_gap_and_beyond_its_reach(time, present):
    assert with_a_gap().present(np.array([time])).tolist() == [present]


def test_it_spans_all_its_runs():
    assert with_a_gap().span == (-0.25, 3.25)


def test_a_single_annotation_is_static_within_its_reach():
    motion = motion_through([2.0], [[1.0, 2.0, 3.0]], 0.7)
    at = np.array([1.74, 1.75, 2.0, 2.25, 2.26])
    assert motion.present(at).tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(
        motion.poses(at), np.tile(rigid(about_z(0.7), np.array([1.0, 2.0, 3.0])), (5, 1, 1)), atol=1e-12
    )
    np.testing.assert_array_equal(motion.weights(at), np.ones((5, 1)))


def annotated(scene: Scene, key_frames: list[int], poses: list[np.ndarray]) -> Track:
    indices = np.array(key_frames)
    return Track(
        "it", *classed("vehicle.car"), np.array([4.0, 2.0, 1.6]), scene.key_frame_timestamps[indices], indices,
        np.stack(poses), np.full(len(indices), 4),
    )  # fmt: skip


def test_a_tracks_times_start_at_the_first_image_and_its_reach_is_that_of_boxes(tiny_scene):
    """The camera fires 35 ms before the LiDAR, at whose times boxes are annotated, every half second."""
    track = annotated(tiny_scene, [1, 2, 5], [np.eye(4)] * 3)
    motion = Motion.of_track(tiny_scene, track)
    np.testing.assert_allclose(motion.times, [0.535, 1.035, 2.535], atol=1e-9)
    assert motion.runs == ((0, 1), (2, 2)) and motion.reach == pytest.approx(0.25)
    assert motion.object_to_world is track.object_to_world


def test_the_motion_of_a_straight_path_agrees_with_the_measuring_protocol(tiny_scene):
    """Its pose and presence, for two runs with a gap between."""
    key_frames = [0, 1, 2, 3, 6, 7, 8]
    poses = [rigid(about_z(0.3 + 0.2 * i), np.array([4.0 * i, -1.5 * i, 0.1 * i])) for i in key_frames]
    track = annotated(tiny_scene, key_frames, poses)
    motion = Motion.of_track(tiny_scene, track)
    for timestamp in range(
        int(tiny_scene.key_frame_timestamps[0]) - 400_000, int(tiny_scene.key_frame_timestamps[9]), 37_000
    ):
        box = box_at(track, timestamp, tiny_scene.key_frame_interval)
        at = np.array([tiny_scene.seconds(timestamp)])
        assert motion.present(at).tolist() == [box is not None]
        if box is not None:
            np.testing.assert_allclose(motion.poses(at)[0], box.object_to_world, atol=1e-6)


def test_the_path_walked_counts_from_the_first_annotation_and_bridges_gaps():
    motion = with_a_gap()
    at = np.array([-0.25, 0.0, 0.5, 1.2, 3.0, 3.25, 99.0])
    bridge = np.hypot(20.0 - 2.5, 4.5)  # from 1.25 to 2.25 s
    expected = [-0.5, 0.0, 1.0, 2.4, 2.5 + bridge + 1.5, 2.5 + bridge + 2.0, 2.5 + bridge + 2.0]
    np.testing.assert_allclose(motion.walked(at), expected, atol=1e-6)


def test_what_stands_walks_no_path():
    assert not motion_through([2.0], [[1.0, 2.0, 3.0]], 0.7).walked(np.array([1.0, 2.0, 3.0])).any()
