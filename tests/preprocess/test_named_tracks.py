"""Wrong ids of tracks in edits and subjects are refused with the place and the ids there are."""

import pytest

from drivesplat.errors import ConfigError
from drivesplat.preprocess.named_tracks import check_named_tracks
from drivesplat.settings.edit import Edit
from drivesplat.settings.named_tracks import NamedTracks, named_tracks

CAR, TRUCK = "0001 instance 0", "0001 instance 1"
"""The first moves, the second is parked."""


def named(*steps: dict, subject: str | None = None) -> NamedTracks:
    return named_tracks("0001", {"mine": Edit.model_validate({"steps": steps})} if steps else {}, subject)


def test_tracks_that_there_are_pass(tiny_scene):
    steps = ({"stop": {"track": CAR, "at": 1}}, {"remove": {"track": "0001"}})
    record = check_named_tracks(tiny_scene, named(*steps, subject=CAR))
    assert record["edits"]["mine"]["step 1 (stop)"] == [CAR] and record["subject"] == CAR
    assert len(record["edits"]["mine"]["step 2 (remove)"]) > 1, "which of them may be edited is known after training"
    assert not named().any and named(subject=CAR).any and not named({"ego": {"lateral": 1.0}}).any


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ([{"remove": {"track": "9"}}], ["edit 'mine', step 1 (remove): no track has an id starting with '9'", CAR]),
        ([{"remove": {"track": TRUCK}}], [f"no track that moves has an id starting with '{TRUCK}'", CAR]),
        (
            [{"remove": {"track": CAR}}, {"swap": {"track": CAR, "with": "x"}}],
            ["step 2 (swap with): no track has an id starting with 'x'"],
        ),
        ([{"remove": {"track": "copy"}}], ["'copy'"]),
    ],
)
def test_a_wrong_id_in_an_edit_is_named_with_edit_step_and_those_there_are(tiny_scene, steps, words):
    with pytest.raises(ConfigError) as refusal:
        check_named_tracks(tiny_scene, named(*steps))
    message = str(refusal.value)
    assert message.startswith("scene 0001, edit 'mine'") and all(word in message for word in words), message


def test_copies_of_earlier_steps_are_known(tiny_scene):
    copied = {"duplicate": {"track": CAR, "as": "copy", "delay": 2}}
    check_named_tracks(tiny_scene, named(copied, {"remove": {"track": "copy"}}))
    with pytest.raises(ConfigError, match=r"step 1 \(remove\)"):
        check_named_tracks(tiny_scene, named({"remove": {"track": "copy"}}, copied))


def test_a_wrong_subject_is_refused_and_a_parked_one_is_not(tiny_scene):
    check_named_tracks(tiny_scene, named(subject=TRUCK))
    with pytest.raises(ConfigError, match=r"subjects\.0001: there is no track '0001 instance'; did you mean"):
        check_named_tracks(tiny_scene, named(subject="0001 instance"))
