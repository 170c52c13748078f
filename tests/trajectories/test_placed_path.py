"""Copies that an edit places on a path of their own: position, heading, ground, presence, refusals."""

import numpy as np
import pytest

from drivesplat.errors import ConfigError
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import rigid
from drivesplat.settings.edit import Edit, Place
from drivesplat.trajectories.edited_actors import EditedActor, edited_actors
from drivesplat.trajectories.motion import Motion
from drivesplat.trajectories.steps import placed_motion

SIZE = np.array([4.0, 2.0, 1.5])
EGO = 8.0 * np.arange(0.0, 10.0, 0.1)
"""Metres along the ego vehicle's path."""


def ego_poses(yaw: float = 0.0, slope: float = 0.0) -> np.ndarray:
    """Ego to world (n, 4, 4) along a straight road that turns `yaw` degrees from x and rises at `slope`."""
    turn, pitch = np.radians(yaw), np.arctan(slope)
    forward = np.array([np.cos(turn) * np.cos(pitch), np.sin(turn) * np.cos(pitch), np.sin(pitch)])
    left = np.array([-np.sin(turn), np.cos(turn), 0.0])
    rotation = np.stack([forward, left, np.cross(forward, left)], axis=1)
    return np.stack([rigid(rotation, np.array([100.0, 50.0, 2.0]) + distance * forward) for distance in EGO])


def place(path: list, yaw: float = 0.0) -> Place:
    return Place(track="x", **{"as": "new"}, path=tuple(map(tuple, path)), yaw=yaw)


def heading(poses: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))


def test_a_copy_drives_through_its_points_in_the_first_ego_frame():
    ego = ego_poses(yaw=90.0)
    motion = placed_motion(place([[1.0, 30.0, 3.5], [3.0, 10.0, 3.5], [4.0, 0.0, 3.5]]).path, ego, 1.5)
    poses = motion.poses(np.array([1.0, 2.0, 3.0, 4.0]))
    # the ego vehicle drives along y: ahead is y, to its left is -x
    np.testing.assert_allclose(poses[:, :2, 3], [[96.5, 80.0], [96.5, 70.0], [96.5, 60.0], [96.5, 50.0]], atol=0.01)
    np.testing.assert_allclose(poses[:, 2, 3], 2.0 + 0.75, atol=1e-6)
    np.testing.assert_allclose(heading(poses), -90.0, atol=0.1)


def test_a_bent_path_turns_the_copy_into_its_direction():
    """Three points of a circle of radius 20 m about the left: its spline turns by about the circle's angle."""
    angles = np.radians([0.0, 45.0, 90.0])
    points = [[float(t), 20.0 * np.sin(a), 20.0 - 20.0 * np.cos(a)] for t, a in zip((0, 2, 4), angles, strict=True)]
    poses = placed_motion(place(points).path, ego_poses(), 1.5).poses(np.linspace(0.0, 4.0, 41))
    assert heading(poses)[20] == pytest.approx(45.0, abs=2.0)
    assert (np.diff(heading(poses)) > -1e-6).all()
    step = np.diff(poses[:, :2, 3], axis=0)
    along = np.degrees(np.arctan2(step[:, 1], step[:, 0]))
    np.testing.assert_allclose(along, (heading(poses)[1:] + heading(poses)[:-1]) / 2, atol=1.0)


def test_yaw_turns_the_copy_beside_its_direction():
    poses = placed_motion([(0.0, 0.0, 0.0), (4.0, 20.0, 0.0)], ego_poses(), 1.5, yaw=30.0).poses(np.array([2.0]))
    np.testing.assert_allclose(heading(poses), 30.0, atol=1e-6)


@pytest.mark.parametrize("slope", [0.06, -0.1])
@pytest.mark.parametrize("yaw", [0.0, 120.0])
def test_on_a_slope_a_copy_stands_on_the_ground_and_tilts_with_it(yaw, slope):
    ego = ego_poses(yaw, slope)
    motion = placed_motion(place([[0.0, 40.0, 3.5], [4.0, 10.0, 3.5]]).path, ego, 1.5)
    poses = motion.poses(np.linspace(0.0, 4.0, 9))
    up = np.array([0.0, 0.0, 1.0]) - slope * np.array([np.cos(np.radians(yaw)), np.sin(np.radians(yaw)), 0.0])
    up /= np.linalg.norm(up)
    np.testing.assert_allclose(poses[:, :3, 2], np.tile(up, (9, 1)), atol=1e-6)
    floor = poses[:, :3, 3] - 0.75 * poses[:, :3, 2]
    above = (floor - ego[0, :3, 3]) @ up
    np.testing.assert_allclose(above, 0.0, atol=1e-6)
    assert (poses[:, :3, 0] @ ego[0, :3, 0] < -0.999).all(), "it comes down the road"


def test_a_copy_with_one_point_stands_as_the_ego_vehicle_did():
    motion = placed_motion(place([[2.0, 25.0, -3.5]]).path, ego_poses(yaw=30.0), 1.5)
    poses = motion.poses(np.array([0.0, 2.0, 9.0, 500.0]))
    np.testing.assert_allclose(poses, np.tile(poses[:1], (4, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(heading(poses), 30.0, atol=1e-6)
    ahead, left = np.array([np.cos(np.pi / 6), 0.5]), np.array([-0.5, np.cos(np.pi / 6)])
    np.testing.assert_allclose(poses[0, :2, 3], np.array([100.0, 50.0]) + 25.0 * ahead - 3.5 * left, atol=1e-6)


def recorded(name: str, annotations: int = 9) -> EditedActor:
    """A car at 10 m/s along x, annotated every half second from second 0."""
    times = 0.5 * np.arange(annotations)
    poses = np.tile(np.eye(4), (annotations, 1, 1))
    poses[:, :3, 3] = np.stack([10.0 * times, np.zeros(annotations), np.full(annotations, 0.75)], axis=-1)
    return EditedActor.recorded(
        name, ObjectClass.CAR, "vehicle.car", SIZE, Motion(times, poses, ((0, annotations - 1),), 0.25)
    )


def edited(*steps: dict, others: tuple[str, ...] = ()) -> list[EditedActor]:
    edit = Edit.model_validate({"steps": steps})
    return edited_actors([recorded("6e5c"), recorded("7a11")], edit, "here", others, ego_poses())


PLACED = {"place": {"track": "6e", "as": "new", "path": [[1.0, 10.0, 3.5], [5.0, 30.0, 3.5]]}}


def test_a_placed_copy_is_another_actor_with_the_gaussians_of_its_track():
    actors = edited(PLACED)
    assert [(actor.id, actor.source, actor.edited) for actor in actors] == [
        ("6e5c", "6e5c", False), ("7a11", "7a11", False), ("new", "6e5c", True)
    ]  # fmt: skip
    np.testing.assert_allclose(actors[2].poses(np.array([3.0]))[0, :3, 3], [120.0, 53.5, 2.75], atol=0.02)


def test_a_placed_copy_is_present_from_its_first_point_to_its_last():
    times = np.arange(0.0, 8.0, 0.25)
    present = edited(PLACED)[2].present(times)
    assert present[(times >= 1.0) & (times <= 5.0)].all() and not present[(times < 0.9) | (times > 5.1)].any()
    standing = edited({"place": {"track": "6e", "as": "new", "path": [[1.0, 10.0, 3.5]]}})[2]
    assert standing.present(np.array([1.0, 5.0, 300.0])).all() and not standing.present(np.array([0.5])).any()


def test_a_removed_track_can_be_placed_elsewhere_as_it_was_before():
    """The order of "replace the car": remove, then place."""
    bigger, removed = {"rescale": {"track": "6e", "factor": 2.0}}, {"remove": {"track": "6e"}}
    replaced, as_before = edited(bigger, removed, PLACED), edited(bigger, PLACED, removed)
    assert [(one.id, one.source, one.scale) for one in replaced] == [
        ("7a11", "7a11", 1.0),
        ("new", "6e5c", 2.0),
    ]
    times = np.array([1.0, 3.0])
    np.testing.assert_array_equal(replaced[1].poses(times), as_before[1].poses(times))
    with pytest.raises(ConfigError, match=r"step 3 \(shift\): track 6e5c was removed by step 1"):
        edited(removed, PLACED, {"shift": {"track": "6e5c", "lateral": 1.0}})


def test_later_steps_change_a_placed_copy():
    shifted = edited(PLACED, {"shift": {"track": "new", "lateral": 1.0}}, {"rescale": {"track": "new", "factor": 2.0}})
    np.testing.assert_allclose(shifted[2].poses(np.array([3.0]))[0, :3, 3], [120.0, 54.5, 2.0 + 1.5], atol=0.02)
    assert [actor.id for actor in edited(PLACED, {"remove": {"track": "new"}})] == ["6e5c", "7a11"]


def test_a_scaled_track_is_placed_at_its_size():
    bigger = edited({"rescale": {"track": "6e", "factor": 2.0}}, PLACED)[2]
    np.testing.assert_allclose(bigger.size, 2.0 * SIZE)
    assert bigger.poses(np.array([3.0]))[0, 2, 3] == pytest.approx(2.0 + 1.5, abs=0.01)


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ([{"place": {**PLACED["place"], "as": "7a11"}}],
         "here, step 1 (place): the name '7a11' in 'as' is already used; names in use: 6e5c, 7a11"),
        ([PLACED, PLACED],
         "here, step 2 (place): the name 'new' in 'as' is already used; names in use: 6e5c, 7a11, new"),
        ([{"place": {**PLACED["place"], "as": "walker"}}],
         "here, step 1 (place): the name 'walker' in 'as' is the id of another track; choose another name"),
        ([{"place": {**PLACED["place"], "track": "ff"}}],
         "here, step 1 (place): no editable track has an id starting with 'ff'; editable tracks: 6e5c, 7a11"),
    ],
)  # fmt: skip
def test_names_that_are_taken_and_unknown_tracks_are_refused(steps, said):
    with pytest.raises(ConfigError) as refused:
        edited(*steps, others=("walker",))
    assert str(refused.value) == said
