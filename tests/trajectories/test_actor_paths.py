"""Poses of actors in an edited drive, compared with closed forms on straight and circular paths."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.errors import ConfigError
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import rigid
from drivesplat.settings.edit import Edit
from drivesplat.trajectories.edited_actors import EditedActor, edited_actors
from drivesplat.trajectories.motion import Motion

SPEED, RADIUS, END = 10.0, 20.0, 10.0
FILM = np.arange(0.0, END, 1 / 30)
SIZE = np.array([4.0, 2.0, 1.5])
DIRECTION = np.array([np.cos(0.6), np.sin(0.6), 0.0])
"""Direction of the straight path."""
LEFT = np.array([-np.sin(0.6), np.cos(0.6), 0.0])


def driver(pose_at, key_frames=range(21), name="car", size=SIZE, category="vehicle.car") -> EditedActor:
    """An object annotated at `key_frames`, half a second apart, where `pose_at` says."""
    indices = np.array(key_frames)
    ends = np.flatnonzero(np.diff(indices) != 1)
    runs = zip([0, *(ends + 1).tolist()], [*ends.tolist(), len(indices) - 1], strict=True)
    poses = np.stack([pose_at(0.5 * i) for i in key_frames])
    return EditedActor.recorded(
        name, ObjectClass.VEHICLE, category, size, Motion(0.5 * indices, poses, tuple(runs), 0.25)
    )


def facing(yaw: float, place, pitch: float = 0.0) -> np.ndarray:
    return rigid(Rotation.from_euler("ZY", [yaw, pitch]).as_matrix(), np.asarray(place, dtype=float))


def straight(seconds: float) -> np.ndarray:
    return facing(0.6, SPEED * seconds * DIRECTION + [0, 0, 0.75])


def circle(seconds: float) -> np.ndarray:
    """A left turn about the origin."""
    turn = SPEED / RADIUS * seconds
    return facing(turn, [RADIUS * np.sin(turn), -RADIUS * np.cos(turn), 0.75])


def waiting(seconds: float) -> np.ndarray:
    """Drives, brakes, waits from second 3 to 6, while its annotated heading trembles, and drives on."""
    moved = np.interp(seconds, [0, 2, 3, 6, 7, 20], [0, 20, 25, 25, 30, 160])
    trembling = 0.01 * np.sin(17.0 * seconds) if 3 <= seconds <= 6 else 0.0
    return facing(0.6 + trembling, moved * DIRECTION + [0, 0, 0.75])


def parked(seconds: float) -> np.ndarray:
    return facing(0.6, [3.0, 4.0, 0.75])


def edited_by_id(actors: list[EditedActor], *steps: dict) -> dict[str, EditedActor]:
    edited = edited_actors(actors, Edit.model_validate({"steps": steps}), "edits.yaml: edit 'it'")
    return {actor.id: actor for actor in edited}


def edited(pose_at, *steps: dict, **recorded) -> EditedActor:
    """The only car after `steps`, which are given without its name."""
    named = [{kind: {"track": "car", **fields} for kind, fields in step.items()} for step in steps]
    return edited_by_id([driver(pose_at, **recorded)], *named)["car"]


def moved(actor: EditedActor, at) -> np.ndarray:
    """The distance of an actor along the straight path."""
    return (actor.poses(np.atleast_1d(at))[:, :3, 3] - straight(0.0)[:3, 3]) @ DIRECTION


def yaws(poses: np.ndarray) -> np.ndarray:
    return np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))


def degrees_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(Rotation.from_matrix(np.swapaxes(a, -1, -2)[..., :3, :3] @ b[..., :3, :3]).magnitude())


def directions(actor: EditedActor, at: np.ndarray, step: float = 1e-3) -> np.ndarray:
    """Where the box centre moves (n,) in radians, from its places shortly before and after."""
    velocity = (actor.poses(at + step) - actor.poses(at - step))[:, :2, 3]
    return np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))


def speeds(actor: EditedActor, at: np.ndarray, step: float = 1e-3) -> np.ndarray:
    return np.linalg.norm((actor.poses(at + step) - actor.poses(at - step))[:, :3, 3], axis=1) / (2 * step)


def rise(x) -> np.ndarray:
    """The quintic from 0 to 1 with two vanishing derivatives at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


LATER = [
    {"speed": {"factor": 1.7, "start": 4.0}},
    {"speed": {"to": 3.0, "start": 4.0, "duration": 2.0}},
    {"stop": {"at": 4.0}},
    {"shift": {"lateral": 3.5, "longitudinal": 4.0, "yaw": 20.0, "start": 4.0}},
]


@pytest.mark.parametrize(
    ("pose_at", "step"),
    [*((circle, step) for step in LATER), (waiting, LATER[3]), (parked, LATER[1])],
)
def test_an_actor_is_as_recorded_until_the_edit_starts(pose_at, step):
    actor, at = edited(pose_at, step), np.arange(0.0, 4.0, 0.01)
    recorded = driver(pose_at).path.trajectory.motion.poses(at)
    assert np.linalg.norm((actor.poses(at) - recorded)[:, :3, 3], axis=1).max() < 1e-9
    assert degrees_between(actor.poses(at), recorded).max() < 1e-6
    assert actor.edited and actor.present(at).all()


def test_a_speed_factor_from_the_start_scales_the_distance():
    actor = edited(straight, {"speed": {"factor": 1.5}})
    np.testing.assert_allclose(moved(actor, FILM), 1.5 * SPEED * FILM, atol=1e-9)


def test_past_the_end_of_its_track_an_actor_drives_straight_on():
    actor = edited(circle, {"speed": {"factor": 1.5}})
    at, tangent = np.array([8.0, 9.0, 10.0]), np.array([np.cos(5.0), np.sin(5.0), 0.0])
    places = actor.poses(at)[:, :3, 3]
    np.testing.assert_allclose(np.diff(places, axis=0), 1.5 * SPEED * tangent[None].repeat(2, axis=0), atol=0.05)
    np.testing.assert_allclose(places, circle(END)[:3, 3] + (1.5 * at - END)[:, None] * SPEED * tangent, atol=0.4)
    assert actor.present(np.array([0.0, 10.2])).all() and not actor.present(np.array([10.3])).any()
    assert np.ptp(yaws(actor.poses(at))) < 1e-9, "it no longer turns"
    np.testing.assert_allclose(yaws(actor.poses(at)), 5.0 - 2 * np.pi, atol=np.radians(2))


def noisy(pose_at, seed):
    """Annotated with noise of 3 cm, and 1 cm in height."""
    noise = np.random.default_rng(seed)

    def annotated(seconds: float) -> np.ndarray:
        pose = pose_at(seconds)
        return facing(yaws(pose[None])[0], pose[:3, 3] + noise.normal(size=3) * [0.03, 0.03, 0.01])

    return annotated


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("step", [{"speed": {"factor": 2.0}}, {"shift": {"yaw": 1.0}}, {"stop": {"at": 9.0}}])
def test_an_actor_that_stands_at_the_end_of_its_track_stays_there(step, seed):
    """It drives 50 m, and waits from second 6 on."""
    actor = edited(noisy(lambda seconds: straight(min(seconds, 6.0)), seed), step, key_frames=range(25))
    rest = actor.poses(np.array([13.0, 20.0, 60.0]))[:, :3, 3]
    np.testing.assert_allclose(rest, straight(6.0)[None, :3, 3].repeat(3, axis=0), atol=0.25)
    np.testing.assert_allclose(rest[1:], rest[:1].repeat(2, axis=0), atol=1e-9)


def test_a_speed_factor_takes_effect_over_its_duration():
    actor = edited(straight, {"speed": {"factor": 1.5, "start": 2.0, "duration": 3.0}})
    at = np.linspace(0.1, 9.0, 400)
    np.testing.assert_allclose(speeds(actor, at), SPEED * (1 + 0.5 * rise((at - 2.0) / 3.0)), atol=1e-4)
    np.testing.assert_allclose(moved(actor, 8.0), SPEED * (2.0 + 1.25 * 3.0 + 1.5 * 3.0), atol=1e-9)


@pytest.mark.parametrize("target", [3.0, 14.0])
def test_a_constant_speed_is_reached_over_the_duration_and_kept(target):
    actor = edited(straight, {"speed": {"to": target, "start": 2.0, "duration": 3.0}})
    at = np.linspace(0.1, 9.0, 400)
    share = rise((at - 2.0) / 3.0)
    np.testing.assert_allclose(speeds(actor, at), SPEED * (1 - share) + target * share, atol=1e-3)
    np.testing.assert_allclose(moved(actor, 8.0), SPEED * 2 + (SPEED + target) / 2 * 3 + target * 3, atol=1e-4)


def test_a_constant_speed_from_the_start():
    actor = edited(straight, {"speed": {"to": 4.0}})
    np.testing.assert_allclose(moved(actor, FILM), 4.0 * FILM, atol=1e-6)
    assert actor.present(np.array([20.0])).all(), "it is still within its recorded path"


def test_a_stop_brakes_over_its_duration_and_holds():
    actor = edited(straight, {"stop": {"at": 4.0, "duration": 2.0}})
    at = np.linspace(0.1, 9.0, 400)
    np.testing.assert_allclose(speeds(actor, at), SPEED * (1 - rise((at - 4.0) / 2.0)), atol=1e-4)
    np.testing.assert_allclose(moved(actor, [6.0, 7.0, 60.0]), SPEED * 4.0 + SPEED * 2.0 / 2, atol=1e-9)
    assert actor.present(np.array([60.0])).all(), "a stopped actor stays present"


def test_speed_factors_multiply():
    actor = edited(straight, {"speed": {"factor": 2.0}}, {"speed": {"factor": 0.5, "start": 4.0, "duration": 2.0}})
    np.testing.assert_allclose(speeds(actor, np.array([2.0, 8.0])), [20.0, 10.0], atol=1e-6)


def test_with_a_speed_factor_a_waiting_actor_waits_as_recorded():
    actor, motion = edited(waiting, {"speed": {"factor": 2.0}}), driver(waiting).path.trajectory.motion
    at = np.arange(0.0, 4.9, 0.01)
    np.testing.assert_allclose(actor.poses(at), motion.poses(2.0 * at), atol=1e-9)


def test_a_parked_vehicle_drives_off_along_its_heading():
    actor = edited(parked, {"speed": {"to": 5.0, "start": 2.0, "duration": 2.0}})
    expected = parked(0)[:3, 3] + (5.0 * 1.0 + 5.0 * 3.0) * DIRECTION
    np.testing.assert_allclose(actor.poses(np.array([7.0]))[0, :3, 3], expected, atol=1e-6)
    np.testing.assert_allclose(actor.poses(np.array([7.0]))[0, :3, :3], parked(0)[:3, :3], atol=1e-9)


@pytest.mark.parametrize("lateral", [3.5, -2.0])
def test_a_shift_from_the_start_gives_a_parallel_path(lateral):
    actor, motion = edited(circle, {"shift": {"lateral": lateral}}), driver(circle).path.trajectory.motion
    poses, recorded = actor.poses(FILM), motion.poses(FILM)
    np.testing.assert_allclose(poses[:, :3, :3], recorded[:, :3, :3], atol=1e-12)
    middle = (FILM > 2) & (FILM < 8)
    np.testing.assert_allclose(np.linalg.norm(poses[middle, :2, 3], axis=1), RADIUS - lateral, atol=0.01)


@pytest.mark.parametrize("lateral", [3.5, -3.5])
def test_in_a_lane_change_the_vehicle_points_along_its_motion(lateral):
    actor, at = (
        edited(straight, {"shift": {"lateral": lateral, "start": 2.0, "duration": 3.0}}),
        np.arange(0.5, 9, 0.01),
    )
    aside = (actor.poses(at)[:, :3, 3] - straight(0.0)[:3, 3]) @ LEFT
    np.testing.assert_allclose(aside, lateral * rise((at - 2.0) / 3.0), atol=1e-9)
    np.testing.assert_allclose(yaws(actor.poses(at)), directions(actor, at), atol=np.radians(0.01))
    assert np.degrees(np.abs(yaws(actor.poses(at)) - 0.6)).max() == pytest.approx(
        np.degrees(np.arctan(1.875 * 3.5 / 3.0 / SPEED)), abs=0.05
    )


@pytest.mark.parametrize("lateral", [3.5, -3.5])
def test_in_a_lane_change_in_a_bend_the_vehicle_points_along_its_motion(lateral):
    """There the inner lane is shorter than the path."""
    actor, at = edited(circle, {"shift": {"lateral": lateral, "start": 3.0, "duration": 3.0}}), np.arange(2.5, 7, 0.01)
    np.testing.assert_allclose(yaws(actor.poses(at)), directions(actor, at), atol=np.radians(0.1))


def test_a_shifted_standing_vehicle_keeps_its_heading():
    actor = edited(parked, {"shift": {"lateral": 2.0, "start": 2.0, "duration": 3.0}})
    np.testing.assert_allclose(actor.poses(FILM)[:, :3, :3], np.tile(parked(0)[:3, :3], (len(FILM), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(actor.poses(np.array([6.0]))[0, :3, 3], parked(0)[:3, 3] + 2.0 * LEFT, atol=1e-9)


def test_a_yaw_rotates_an_actor_to_the_left_in_place():
    actor = edited(straight, {"shift": {"yaw": 30.0, "start": 2.0, "duration": 1.0}})
    np.testing.assert_allclose(moved(actor, FILM), SPEED * FILM, atol=1e-9)
    np.testing.assert_allclose(yaws(actor.poses(np.array([1.0, 2.5, 4.0]))), 0.6 + np.radians([0, 15, 30]), atol=1e-9)


def test_a_longitudinal_shift_follows_the_bends_of_the_path():
    actor, at = edited(circle, {"shift": {"longitudinal": -12.0}}), np.arange(3.0, 8.0, 0.05)
    expected = np.stack([circle(t - 12.0 / SPEED) for t in at])
    np.testing.assert_allclose(actor.poses(at)[:, :3, 3], expected[:, :3, 3], atol=0.01)
    assert degrees_between(actor.poses(at), expected).max() < 0.1


@pytest.mark.parametrize("pose_at", [straight, circle, waiting])
def test_a_reversed_actor_follows_the_recording_backwards_in_time(pose_at):
    actor, motion = edited(pose_at, {"reverse": {}}), driver(pose_at).path.trajectory.motion
    np.testing.assert_allclose(actor.poses(FILM), motion.poses(END - FILM), atol=1e-9)
    turned = edited(pose_at, {"reverse": {"turn": True}}).poses(FILM)
    np.testing.assert_allclose(turned[:, :3, 3], actor.poses(FILM)[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(turned[:, :3, :2], -actor.poses(FILM)[:, :3, :2], atol=1e-9)


def test_limbs_follow_the_pace_of_an_edit():
    """Slower, standing, backwards, and turned round: half the distance, none, the same distance back and forth."""
    slow, waits = edited(straight, {"speed": {"factor": 0.5}}), edited(straight, {"stop": {"at": 5.0}})
    back, turned = (edited(straight, {"reverse": {"turn": turn}}) for turn in (False, True))
    assert advance(slow, 2.0, 6.0) == pytest.approx(0.5 * SPEED * 4.0, rel=0.01)
    assert abs(advance(waits, 8.0, 9.0)) < 1e-6 and advance(waits, 0.0, 2.0) > 1.0
    assert advance(back, 2.0, 3.0) == pytest.approx(-SPEED, rel=0.01)
    assert advance(turned, 2.0, 3.0) == pytest.approx(SPEED, rel=0.01)


def advance(actor: EditedActor, first: float, last: float) -> float:
    return float(np.diff(actor.walked(np.array([first, last])))[0])


def test_a_constant_speed_after_a_reversal_is_backwards():
    actor = edited(straight, {"reverse": {}}, {"speed": {"to": 4.0, "start": 2.0, "duration": 2.0}})
    np.testing.assert_allclose(moved(actor, 6.0), 100.0 - 10.0 * 2 - 7.0 * 2 - 4.0 * 2, atol=1e-4)


def test_a_rescaled_actor_stays_on_the_ground():
    def uphill(seconds: float) -> np.ndarray:
        return facing(0.6, [8.0 * seconds, 0.0, 1.0], pitch=-0.2)

    actor, recorded = edited(uphill, {"rescale": {"factor": 1.3}}), driver(uphill).path.trajectory.motion.poses(FILM)
    assert actor.scale == pytest.approx(1.3) and actor.source == "car"
    np.testing.assert_allclose(actor.size, 1.3 * SIZE)
    ground = [0.0, 0.0, -SIZE[2] / 2, 1.0]
    np.testing.assert_allclose(actor.poses(FILM) @ [0, 0, 1.3 * ground[2], 1.0], recorded @ ground, atol=1e-9)
    np.testing.assert_allclose(actor.poses(FILM)[:, :3, :3], recorded[:, :3, :3], atol=1e-9)
    twice = edited(uphill, {"rescale": {"factor": 1.3}}, {"rescale": {"factor": 2.0}})
    assert twice.scale == pytest.approx(2.6)


def test_swapped_actors_follow_each_others_path_on_the_ground():
    tall = driver(circle, range(4, 12), name="truck", size=np.array([8.0, 2.5, 3.5]), category="vehicle.truck")
    actors = edited_by_id([driver(straight), tall], {"swap": {"track": "car", "with": "truck"}})
    car, truck = actors["car"], actors["truck"]
    at = np.arange(2.0, 5.0, 0.1)
    np.testing.assert_allclose(
        car.poses(at) @ [0, 0, -0.75, 1], tall.path.trajectory.motion.poses(at) @ [0, 0, -1.75, 1], atol=1e-9
    )
    straight_on = driver(straight).path.trajectory.motion.poses(at)
    np.testing.assert_allclose(truck.poses(at) @ [0, 0, -1.75, 1], straight_on @ [0, 0, -0.75, 1], atol=1e-9)
    np.testing.assert_array_equal(car.present(FILM), tall.path.trajectory.motion.present(FILM))
    assert truck.present(FILM).all()
    assert (car.source, car.category, car.scale) == ("car", "vehicle.car", 1.0)
    np.testing.assert_array_equal(truck.size, tall.size)


def test_a_duplicate_follows_its_original_and_later_steps_move_only_it():
    actors = edited_by_id(
        [driver(circle)],
        {"duplicate": {"track": "car", "as": "twin", "longitudinal": -12.0, "lateral": 1.0}},
        {"stop": {"track": "twin", "at": 6.0, "duration": 1.0}},
    )
    twin, at = actors["twin"], np.arange(3.0, 6.0, 0.1)
    assert (twin.id, twin.source, twin.edited, actors["car"].edited) == ("twin", "car", True, False)
    behind = np.stack([circle(t - 1.2) for t in at]) @ [0, 1.0, 0, 1]
    np.testing.assert_allclose(twin.poses(at)[:, :3, 3], behind[:, :3], atol=0.01)
    np.testing.assert_allclose(speeds(twin, np.array([8.0])), 0.0, atol=1e-6)
    assert list(actors) == ["car", "twin"]


@pytest.mark.parametrize(
    "step",
    [
        {"speed": {"factor": 1.5}},
        {"speed": {"to": 7.0, "start": 1.0}},
        {"shift": {"longitudinal": 6.0}},
        {"reverse": {}},
    ],
)
def test_an_actor_does_not_jump_across_a_gap_of_its_track(step):
    """The track has no annotations from 4 to 6 s."""
    key_frames = [i for i in range(21) if not 8 < i < 12]
    actor = edited(circle, step, key_frames=key_frames)
    at = np.arange(0.0, 10.0, 0.002)
    at = at[actor.present(at)]
    together = np.diff(at) < 0.003
    poses = actor.poses(at)
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)[together].max() < 0.002 * 1.7 * SPEED
    assert degrees_between(poses[1:], poses[:-1])[together].max() < np.degrees(0.002 * 1.7 * SPEED / RADIUS)


@pytest.mark.parametrize(
    ("steps", "there", "gone"),
    [
        ([{"speed": {"factor": 0.5}}], [0.0, 15.0, 20.4], [20.6, 60.0]),
        ([{"speed": {"factor": 0.5}}, {"speed": {"factor": 4.0}}], [0.0, 4.0, 10.2], [10.3, 20.0]),
        ([{"speed": {"factor": 0.5}}, {"reverse": {}}], [0.0, 9.9, 10.2], [11.0, 20.0]),
        ([{"stop": {"at": 2.0}}, {"speed": {"to": 20.0, "start": 4.0}}], [0.0, 3.0, 8.0, 10.2], [10.3, 60.0]),
        ([{"stop": {"at": 2.0}}, {"reverse": {}}], [0.0, 5.0, 10.2], [10.6, 60.0]),
        ([{"stop": {"at": 2.0}}, {"speed": {"to": 2.0, "start": 4.0}}], [0.0, 12.0, 30.0], [60.0]),
        ([{"shift": {"longitudinal": 60.0}}, {"stop": {"at": 8.0}}], [0.0, 9.0, 60.0], []),
    ],
)
def test_an_actor_is_present_when_or_where_it_was_recorded(steps, there, gone):
    """Recorded from 0 to 100 m, and from 0 to 10 s."""
    actor = edited(straight, *steps)
    np.testing.assert_array_equal(actor.present(np.array(there)), True)
    np.testing.assert_array_equal(actor.present(np.array(gone)), False)


@pytest.mark.parametrize(
    ("steps", "second"),
    [
        ([{"stop": {"at": 2.0}}, {"speed": {"factor": 2.0, "start": 6.0}}], "6.00"),
        ([{"stop": {"at": 0.0, "duration": 0.0}}, {"speed": {"factor": 2.0}}], "0.00"),
    ],
)
def test_a_speed_factor_of_a_standing_actor_is_refused(steps, second):
    with pytest.raises(ConfigError, match=f"step 2 .speed.: the track stands from {second} s on, where .factor"):
        edited(straight, *steps)
