"""Which actors the steps of an edit name, and which steps are refused with which message."""

import numpy as np
import pytest

from drivesplat.errors import ConfigError
from drivesplat.scene.object_class import ObjectClass
from drivesplat.settings.edit import Edit, Recolour
from drivesplat.trajectories.edited_actors import EditedActor, color_matrix, edited_actors
from drivesplat.trajectories.motion import Motion

IDS = ("6e5c0000aaaa", "6e7d0000bbbb", "91ab0000cccc")


def recorded(name: str, first: int = 4, last: int = 12) -> EditedActor:
    """A car at 10 m/s, annotated half a second apart from key frame `first` to `last`."""
    times = 0.5 * np.arange(first, last + 1)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = 10.0 * times
    return EditedActor.recorded(
        name,
        ObjectClass.CAR,
        "vehicle.car",
        np.array([4.0, 2.0, 1.5]),
        Motion(times, poses, ((0, len(times) - 1),), 0.25),
    )


def edited(*steps: dict) -> list:
    return edited_actors(
        [recorded(name) for name in IDS], Edit.model_validate({"steps": steps}), "edits.yaml: edit 'a'"
    )


def refusal(*steps: dict) -> str:
    with pytest.raises(ConfigError) as caught:
        edited(*steps)
    message = str(caught.value)
    assert "\n" not in message
    return message.removeprefix("edits.yaml: edit 'a', ")


REMOVE = {"remove": {"track": "6e5c"}}
TWIN = {"duplicate": {"track": "91", "as": "twin"}}
EDITABLE = "6e5c0000, 6e7d0000, 91ab0000"


def test_a_prefix_names_a_track_and_removed_tracks_are_absent():
    assert [actor.id for actor in edited(REMOVE, {"remove": {"track": "9"}})] == [IDS[1]]


def test_a_duplicate_outlives_its_original_and_has_its_gaussians():
    actors = edited(TWIN, {"remove": {"track": "91ab"}}, {"duplicate": {"track": "twin", "as": "third"}})
    assert [(actor.id, actor.source) for actor in actors[2:]] == [("twin", IDS[2]), ("third", IDS[2])]


def test_recolourings_multiply_and_a_copy_carries_those_made_before_it():
    first, second = ({"track": "91", "hue": 30.0, "value": 0.5}, {"track": "91", "colour": "red"})
    alone = {"track": "twin", "saturation": 0.0}
    actors = edited({"recolour": first}, TWIN, {"recolour": second}, {"recolour": alone})
    matrices = [color_matrix(Recolour(**change)) for change in (first, second, alone)]
    assert [actor.color_matrix is None for actor in actors] == [True, True, False, False]
    np.testing.assert_allclose(actors[2].color_matrix, matrices[1] @ matrices[0])
    np.testing.assert_allclose(actors[3].color_matrix, matrices[2] @ matrices[0])
    assert [actor.edited for actor in actors] == [False, False, True, True]


def test_swapped_actors_keep_their_colours():
    actors = edited({"recolour": {"track": "91", "value": 0.5}}, {"swap": {"track": "91", "with": "6e5c"}})
    assert [actor.color_matrix is None for actor in actors] == [True, True, False]


def test_an_exact_id_takes_precedence_over_prefixes():
    actors = edited({"duplicate": {"track": IDS[2], "as": "6e"}}, {"stop": {"track": "6e", "at": 3.0}})
    assert [actor.edited for actor in actors] == [False, False, False, True]


def test_the_ego_vehicle_is_no_actor():
    assert not any(actor.edited for actor in edited({"ego": {"lateral": 2.0}}))


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ([{"stop": {"track": "ff", "at": 3.0}}],
         f"step 1 (stop): no editable track has an id starting with 'ff'; editable tracks: {EDITABLE}"),
        ([{"reverse": {"track": "6e"}}],
         "step 1 (reverse): 2 tracks have ids starting with '6e': 6e5c0000, 6e7d0000; give more characters"),
        ([REMOVE, {"reverse": {"track": "6e5c"}}],
         "step 2 (reverse): track 6e5c0000 was removed by step 1; remaining tracks: 6e7d0000, 91ab0000"),
        ([REMOVE, REMOVE],
         "step 2 (remove): track 6e5c0000 was removed by step 1; remaining tracks: 6e7d0000, 91ab0000"),
        ([REMOVE, {"swap": {"track": "91", "with": "6e5c"}}],
         "step 2 (swap): track 6e5c0000 was removed by step 1; remaining tracks: 6e7d0000, 91ab0000"),
        ([{"swap": {"track": "91", "with": "91ab"}}],
         "step 1 (swap): '91' and '91ab' are the same track; name two tracks"),
        ([{"swap": {"track": "91", "with": "x"}}],
         f"step 1 (swap): no editable track has an id starting with 'x'; editable tracks: {EDITABLE}"),
        ([TWIN, TWIN],
         f"step 2 (duplicate): the name 'twin' in 'as' is already used; names in use: {EDITABLE}, twin"),
        ([{"duplicate": {"track": "91", "as": IDS[0]}}],
         f"step 1 (duplicate): the name '{IDS[0]}' in 'as' is already used; "
         f"names in use: {EDITABLE}"),
        ([REMOVE, {"duplicate": {"track": "91", "as": IDS[0]}}],
         f"step 2 (duplicate): the name '{IDS[0]}' in 'as' is already used; "
         "names in use: 6e7d0000, 91ab0000, 6e5c0000"),
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
def test_invalid_steps_are_refused_with_their_number(steps, expected):
    assert refusal(*steps) == expected


def test_a_person_that_the_method_does_not_have_is_answered_with_the_preset_that_has_people():
    edit = Edit.model_validate({"steps": [{"remove": {"track": "walk"}}]})
    with pytest.raises(ConfigError) as refused:
        edited_actors([recorded(name) for name in IDS], edit, "here", {"parked", "walker"})
    assert str(refused.value) == (
        f"here, step 1 (remove): no editable track has an id starting with 'walk'; editable tracks: {EDITABLE}; "
        "the method has no Gaussians of this track alone (people need presets/people.yaml)"
    )


def test_a_duplicate_cannot_have_the_id_of_a_track_that_is_no_actor():
    """Its labels would be ambiguous."""
    edit = Edit.model_validate({"steps": [{"duplicate": {"track": "91", "as": "parked"}}]})
    with pytest.raises(ConfigError, match="the name 'parked' in 'as' is the id of another track; choose another name"):
        edited_actors([recorded(name) for name in IDS], edit, "here", {"parked", "walker"})


def test_no_actor_can_be_named_after_all_are_removed():
    steps = [{"remove": {"track": name}} for name in IDS]
    assert refusal(*steps, REMOVE) == "step 4 (remove): track 6e5c0000 was removed by step 1; remaining tracks: none"


def test_an_actor_that_a_step_keeps_present_can_be_edited_later():
    """At half its speed from 2 s on the car is there until 10 s."""
    slower = {"speed": {"track": "91", "factor": 0.5, "start": 2.0, "duration": 0.0}}
    assert edited(slower, {"stop": {"track": "91", "at": 9.0}})[2].present(np.array([60.0]))[0]
    assert refusal(slower, {"stop": {"track": "91", "at": 11.0}}).startswith("step 2 (stop): the track ends before")


@pytest.mark.parametrize(("delay", "first", "last"), [(-1.0, 0.75, 6.25), (1.0, 1.75, 7.25)])
def test_the_presence_of_a_duplicate_is_extended_by_its_delay(delay, first, last):
    twin = {"duplicate": {"track": "91", "as": "twin", "delay": delay}}
    at = np.array([first - 0.05, first + 0.05, last - 0.05, last + 0.05])
    np.testing.assert_array_equal(edited(twin)[3].present(at), [False, True, True, False])
    edited(twin, {"stop": {"track": "twin", "at": first + 0.05}}, {"stop": {"track": "twin", "at": last - 0.05}})
    assert f"from {first} to {last} s" in refusal(twin, {"stop": {"track": "twin", "at": first - 0.05}})


def test_a_step_that_starts_before_its_track_starts_with_it():
    actor = edited({"speed": {"track": "91", "factor": 2.0, "start": 0.0, "duration": 0.0}})[2]
    np.testing.assert_allclose(actor.poses(np.array([1.75, 2.75]))[:, 0, 3], [17.5, 37.5], atol=1e-9)


def test_ids_with_a_common_prefix_are_shown_up_to_their_difference():
    actors = [recorded("0001 instance 1"), recorded("0001 instance 2")]
    with pytest.raises(ConfigError, match=r"editable tracks: 0001 instance 1, 0001 instance 2$"):
        edited_actors(actors, Edit.model_validate({"steps": [{"remove": {"track": "x"}}]}), "edits.yaml: edit 'a'")
