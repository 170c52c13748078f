"""What annotations say of several actors at once: presence, poses, weights, and the time series of their colours."""

import numpy as np
import pytest
import torch
from helpers.hand_made import motion_through, track_of
from scipy.spatial.transform import Rotation

from drivesplat.io.array_file import read_arrays, write_arrays
from drivesplat.io.typed_record import typed_record
from drivesplat.model import timeline as timeline_module
from drivesplat.model.timeline import ActorTrack, Timeline
from drivesplat.trajectories.motion import Motion

CPU = torch.device("cpu")


def a_van() -> ActorTrack:
    """There from 1 to 3 seconds; it turns a radian a second."""
    times = np.linspace(1.0, 3.0, 5)
    return track_of(motion_through(times, times[:, None] * [4.0, 1.0, 0.0], times), "van", (5.0, 2.0, 2.2))


def a_car() -> ActorTrack:
    """There from 0 to 1 second and again from 2.5 to 4."""
    times = np.array([0.0, 0.5, 1.0, 2.5, 3.0, 3.5, 4.0])
    places = np.random.default_rng(0).uniform(-9, 9, (7, 3))
    return track_of(motion_through(times, places, 0.1 * times, runs=((0, 2), (3, 6))), "car")


def timeline(terms: int = 5) -> Timeline:
    return Timeline([a_van(), a_car()], terms)


@pytest.mark.parametrize(
    ("time", "present"), [(0.5, [False, True]), (0.8, [True, True]), (2.0, [True, False]), (9.0, [False, False])]
)
def test_actors_come_and_go(time, present):
    assert timeline().at(time, CPU).present.tolist() == present


@pytest.mark.parametrize("time", [1.0, 3.1])
def test_poses_of_present_actors_follow_their_motions(time):
    state = timeline().at(time, CPU)
    for i, track in enumerate((a_van(), a_car())):
        (pose,) = track.motion.poses(np.array([time]))
        np.testing.assert_allclose(state.translations[i], pose[:3, 3], rtol=1e-6)
        rotation = Rotation.from_quat(state.quats[i].numpy(), scalar_first=True).as_matrix()
        np.testing.assert_allclose(rotation, pose[:3, :3], atol=1e-6)


def test_weights_are_placed_at_the_annotations_of_their_actor():
    """Those of an absent one are zero."""
    assert timeline().owned == [slice(0, 5), slice(5, 12)]
    assert timeline().of_actors.tolist() == [[True] * 5 + [False] * 7, [False] * 5 + [True] * 7]
    weights = timeline().at(2.6, CPU).weights
    np.testing.assert_allclose(weights[:5], a_van().motion.weights(np.array([2.6]))[0], atol=1e-6)
    np.testing.assert_allclose(weights[5:], a_car().motion.weights(np.array([2.6]))[0], atol=1e-6)
    alone = timeline().at(2.0, CPU).weights
    assert alone[:5].any() and not alone[5:].any()


@pytest.mark.parametrize(
    ("time", "progress"),
    [(1.0, [0.0, 0.25]), (1.5, [0.25, 0.375]), (3.1, [1.0, 0.775]), (0.8, [0.0, 0.2]), (9.0, [1.0, 1.0])],
)
def test_the_series_runs_from_the_first_to_the_last_annotation(time, progress):
    """Of absent actors, too: their colours of a time are asked for when they are placed elsewhere, or written out."""
    expected = [[np.cos(np.pi * i * t) for i in range(5)] for t in progress]
    np.testing.assert_allclose(timeline().at(time, CPU).series, expected, atol=1e-6)
    one = Timeline([track_of(motion_through([2.0], [[0.0, 0.0, 0.0]]))], 3)
    np.testing.assert_allclose(one.at(time, CPU).series[0], np.ones(3), atol=1e-6, err_msg="of a single annotation")


def test_neighbours_follow_one_another_within_a_run():
    """The van's five annotations; the car's three and four, with a gap between that no three reach over."""
    triples = [[0, 1, 2], [1, 2, 3], [2, 3, 4], [5, 6, 7], [8, 9, 10], [9, 10, 11]]
    assert timeline().neighbours.tolist() == triples
    assert Timeline([track_of(motion_through([0.0, 1.0], np.zeros((2, 3))))], 1).neighbours.shape == (0, 3)


def test_a_track_survives_a_checkpoint(tmp_path):
    write_arrays(tmp_path / "a.npz", {"tracks": [a_car()]})
    again = typed_record(ActorTrack, read_arrays(tmp_path / "a.npz", "train")["tracks"][0])
    assert (again.id, again.motion.runs, again.motion.reach) == ("car", ((0, 2), (3, 6)), 0.25)
    np.testing.assert_array_equal(again.size, a_car().size)
    at = np.linspace(-0.5, 4.5, 33)
    np.testing.assert_array_equal(again.motion.poses(at), a_car().motion.poses(at))
    np.testing.assert_array_equal(again.motion.present(at), a_car().motion.present(at))


def test_time_states_computed_together_equal_those_computed_one_by_one():
    seconds = np.linspace(-2.0, 6.0, 41)
    together, one_by_one = timeline(), timeline()
    together.precompute([*seconds, *seconds[:3]], CPU)
    known = [*together._cache.values()]
    assert len(known) == 41 and sum(bool(state.present.any()) for state in known) > 10
    for time, state in zip(seconds, known, strict=True):
        assert together.at(time, CPU) is state
        for name, value in one_by_one.at(time, CPU)._asdict().items():
            torch.testing.assert_close(getattr(state, name), value)


def test_a_full_cache_drops_the_oldest_time_states(monkeypatch):
    monkeypatch.setattr(timeline_module, "MAX_CACHED_TIMES", 3)
    times = timeline()
    times.precompute([0.1, 0.2, 0.3, 0.4, 0.5], CPU)
    assert [time for time, _ in times._cache] == [0.3, 0.4, 0.5]
    times.at(0.1, CPU)
    assert [time for time, _ in times._cache] == [0.4, 0.5, 0.1]


def test_the_cache_holds_the_time_states_of_six_cameras():
    """At 12 Hz for 20 s, each camera at times of its own."""
    times = timeline()
    assert times.at(1.5, CPU) is times.at(1.5, CPU) and times.at(1.5, CPU) is not times.at(1.6, CPU)
    assert timeline_module.MAX_CACHED_TIMES >= 6 * 12 * 20


def test_a_time_state_of_30_actors_takes_less_than_10_kilobytes():
    """Each with 40 annotations, all the key frames of a drive: so many times are kept that it matters."""
    annotated = motion_through(0.5 * np.arange(40), np.zeros((40, 3)))
    state = Timeline([track_of(annotated, str(i)) for i in range(30)], 5).at(1.7, CPU)
    shapes = [(30, 4), (30, 3), (30,), (30 * len(annotated.times),), (30, 5), (30,), (30,)]
    assert [tuple(value.shape) for value in state] == shapes
    assert sum(value.untyped_storage().nbytes() for value in state) < 10_000


@pytest.mark.parametrize(("interval", "scale"), [(0.5, 1.0), (1.0, 1.0 / 16.0), (0.1, 625.0), (0.01, 1e4)])
def test_bends_count_over_the_same_time_whatever_the_annotation_rate(interval, scale):
    """Corrections along one curve cost the same at any rate: of half the interval second differences are a quarter."""
    times = interval * np.arange(5)
    motion = Motion(times, np.tile(np.eye(4), (5, 1, 1)), ((0, 4),), 0.5 * interval)
    assert Timeline([ActorTrack("a", np.ones(3), motion)], 1).bend_scale == pytest.approx(scale)


def test_without_three_annotations_in_a_row_bends_have_no_scale():
    motion = Motion(np.array([0.0, 0.1]), np.tile(np.eye(4), (2, 1, 1)), ((0, 1),), 0.05)
    assert Timeline([ActorTrack("a", np.ones(3), motion)], 1).bend_scale == 1.0
