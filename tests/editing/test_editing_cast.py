"""Whom the steps of an edit name, and which contradictions are refused with what."""

import numpy as np
import pytest

from drivesplat.editing.cast import Actor, edited_cast
from drivesplat.errors import ConfigError
from drivesplat.scene.motion import Motion
from drivesplat.settings.edit import Edit

IDS = ("6e5c0000aaaa", "6e7d0000bbbb", "91ab0000cccc")


def actor(name: str, first: int = 4, last: int = 12) -> Actor:
    """A car at 10 m/s, annotated half a second apart from key frame `first` to `last`."""
    times = 0.5 * np.arange(first, last + 1)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = 10.0 * times
    return Actor(name, "vehicle.car", np.array([4.0, 2.0, 1.5]), Motion(times, poses, ((0, len(times) - 1),), 0.25))


def cast(*steps: dict) -> list:
    return edited_cast([actor(name) for name in IDS], Edit.model_validate({"steps": steps}), "edits.yaml: edit 'a'")


def refusal(*steps: dict) -> str:
    with pytest.raises(ConfigError) as caught:
        cast(*steps)
    message = str(caught.value)
    assert "\n" not in message
    return message.removeprefix("edits.yaml: edit 'a', ")


REMOVE = {"remove": {"track": "6e5c"}}
TWIN = {"duplicate": {"track": "91", "as": "twin"}}
THERE = "6e5c0000, 6e7d0000, 91ab0000"


def test_a_beginning_names_a_track_and_removed_ones_are_absent():
    assert [role.id for role in cast(REMOVE, {"remove": {"track": "9"}})] == [IDS[1]]


def test_a_duplicate_outlives_its_original_and_wears_its_gaussians():
    roles = cast(TWIN, {"remove": {"track": "91ab"}}, {"duplicate": {"track": "twin", "as": "third"}})
    assert [(role.id, role.source) for role in roles[2:]] == [("twin", IDS[2]), ("third", IDS[2])]


def test_a_whole_name_counts_before_beginnings():
    roles = cast({"duplicate": {"track": IDS[2], "as": "6e"}}, {"stop": {"track": "6e", "at": 3.0}})
    assert [role.edited for role in roles] == [False, False, False, True]


def test_the_cameras_car_is_no_actor():
    assert not any(role.edited for role in cast({"ego": {"lateral": 2.0}}))


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ([{"stop": {"track": "ff", "at": 3.0}}],
         f"step 1 (stop): no track that can be edited has an id that begins with 'ff'; there are: {THERE}"),
        ([{"reverse": {"track": "6e"}}],
         "step 1 (reverse): 2 tracks have an id that begins with '6e': 6e5c0000, 6e7d0000; give more of it"),
        ([REMOVE, {"reverse": {"track": "6e5c"}}],
         "step 2 (reverse): track 6e5c0000 was removed by step 1; still there: 6e7d0000, 91ab0000"),
        ([REMOVE, REMOVE], "step 2 (remove): track 6e5c0000 was removed by step 1; still there: 6e7d0000, 91ab0000"),
        ([REMOVE, {"swap": {"track": "91", "with": "6e5c"}}],
         "step 2 (swap): track 6e5c0000 was removed by step 1; still there: 6e7d0000, 91ab0000"),
        ([{"swap": {"track": "91", "with": "91ab"}}], "step 1 (swap): '91' and '91ab' are the same track; name two"),
        ([{"swap": {"track": "91", "with": "x"}}],
         f"step 1 (swap): no track that can be edited has an id that begins with 'x'; there are: {THERE}"),
        ([TWIN, TWIN],
         f"step 2 (duplicate): 'as' is 'twin', which is taken; choose another name than {THERE}, twin"),
        ([{"duplicate": {"track": "91", "as": IDS[0]}}],
         f"step 1 (duplicate): 'as' is '{IDS[0]}', which is taken; choose another name than {THERE}"),
        ([REMOVE, {"duplicate": {"track": "91", "as": IDS[0]}}],
         f"step 2 (duplicate): 'as' is '{IDS[0]}', which is taken; "
         "choose another name than 6e7d0000, 91ab0000, 6e5c0000"),
        ([{"stop": {"track": "91", "at": 1.5}}],
         "step 1 (stop): the track begins after 'at' (1.5 s): it was recorded from 1.75 to 6.25 s"),
        ([{"stop": {"track": "91", "at": 7.0}}],
         "step 1 (stop): the track ends before 'at' (7 s): it was recorded from 1.75 to 6.25 s"),
        ([{"speed": {"track": "91", "factor": 2.0, "start": 7.0}}],
         "step 1 (speed): the track ends before 'start' (7 s): it was recorded from 1.75 to 6.25 s"),
        ([{"shift": {"track": "91", "yaw": 2.0, "start": 7.0}}],
         "step 1 (shift): the track ends before 'start' (7 s): it was recorded from 1.75 to 6.25 s"),
    ],
)  # fmt: skip
def test_contradictions_are_refused_by_the_number_of_the_step(steps, said):
    assert refusal(*steps) == said


def test_a_duplicate_is_not_called_like_a_track_that_is_no_actor():
    """Labels hold that one, too."""
    edit = Edit.model_validate({"steps": [{"duplicate": {"track": "91", "as": "parked"}}]})
    with pytest.raises(ConfigError, match="'as' is 'parked', which is the id of another track; choose another name"):
        edited_cast([actor(name) for name in IDS], edit, "here", {"parked", "walker"})


def test_whom_no_actor_can_be_named_after_everything_is_removed():
    steps = [{"remove": {"track": name}} for name in IDS]
    assert refusal(*steps, REMOVE) == "step 4 (remove): track 6e5c0000 was removed by step 1; still there: none"


def test_what_a_step_keeps_there_can_be_edited_later():
    """At half its speed from 2 s on the car is there until 10 s."""
    slower = {"speed": {"track": "91", "factor": 0.5, "start": 2.0, "duration": 0.0}}
    assert cast(slower, {"stop": {"track": "91", "at": 9.0}})[2].present(np.array([60.0]))[0]
    assert refusal(slower, {"stop": {"track": "91", "at": 11.0}}).startswith("step 2 (stop): the track ends before")


@pytest.mark.parametrize(("delay", "first", "last"), [(-1.0, 0.75, 6.25), (1.0, 1.75, 7.25)])
def test_a_duplicate_is_there_while_its_original_is_and_as_long_before_or_after(delay, first, last):
    twin = {"duplicate": {"track": "91", "as": "twin", "delay": delay}}
    at = np.array([first - 0.05, first + 0.05, last - 0.05, last + 0.05])
    np.testing.assert_array_equal(cast(twin)[3].present(at), [False, True, True, False])
    cast(twin, {"stop": {"track": "twin", "at": first + 0.05}}, {"stop": {"track": "twin", "at": last - 0.05}})
    assert f"from {first} to {last} s" in refusal(twin, {"stop": {"track": "twin", "at": first - 0.05}})


def test_what_begins_before_its_track_begins_with_it():
    role = cast({"speed": {"track": "91", "factor": 2.0, "start": 0.0, "duration": 0.0}})[2]
    np.testing.assert_allclose(role.poses(np.array([1.75, 2.75]))[:, 0, 3], [17.5, 37.5], atol=1e-9)


def test_ids_that_begin_alike_are_shown_as_far_as_they_differ():
    actors = [actor("0001 instance 1"), actor("0001 instance 2")]
    with pytest.raises(ConfigError, match=r"there are: 0001 instance 1, 0001 instance 2$"):
        edited_cast(actors, Edit.model_validate({"steps": [{"remove": {"track": "x"}}]}), "edits.yaml: edit 'a'")
