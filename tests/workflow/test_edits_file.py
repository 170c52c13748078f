"""Edits files: what is read, what travels as a rule's parameter, and what each mistake is answered with."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.io.storage import canonical_json
from drivesplat.scene.object_class import ObjectClass
from drivesplat.settings import Settings
from drivesplat.settings.edit import Edit, Step
from drivesplat.settings.world import WorldSettings
from drivesplat.trajectories.edited_actors import EditedActor, edited_actors
from drivesplat.trajectories.motion import Motion
from drivesplat.workflow.edits_file import read_edits
from drivesplat.world.recorder import Recorder
from drivesplat.world.tokens import instance_token

DEMO = REPOSITORY / "presets" / "edits" / "demo.yaml"
EVERY_STEP = """
edits:
  it:
    - remove: {track: 6e5c}
    - speed: {track: 7a, factor: 1.5, start: 2, duration: 3}
    - speed: {track: 7a, to: 12.0}
    - stop: {track: 7a, at: 6.0}
    - reverse: {track: 7a, turn: true}
    - shift: {track: 7a, lateral: 3.5, start: 2.0}
    - swap: {track: 7a, with: 8b}
    - duplicate: {track: 7a, as: twin, longitudinal: -12}
    - place: {track: 7a, as: placed, path: [[0, 10, 3.5], [4.5, -20, 3.5]], yaw: 5}
    - insert: {asset: demo_b/7a, as: stranger, follow: 7a, start: 2, speed: 5, lateral: 1.5, yaw: 5, phase: 0.5}
    - rescale: {track: twin, factor: 1.3}
    - recolour: {track: twin, colour: firebrick, value: 1.5}
    - ego: {lateral: 2.0, speed: 0.5}
"""


def read(text: str, folder: Path) -> dict[str, Edit]:
    path = folder / "edits.yaml"
    path.write_text(text, encoding="utf-8")
    return read_edits(path)


def refusal(text: str, folder: Path) -> str:
    """What is said of a file, without its folder."""
    with pytest.raises(ConfigError) as caught:
        read(text, folder)
    message = str(caught.value)
    assert "\n" not in message
    return message.removeprefix(f"{folder}/")


def test_a_file_holds_named_edits_in_order(tmp_path):
    text = "edits:\n  b:\n  - remove: {track: x}\n  a:\n  - ego: {lateral: 1}\n  - stop: {track: y, at: 1}"
    edits = read(text, tmp_path)
    kinds = {name: [step.kind for step in edit.steps] for name, edit in edits.items()}
    assert kinds == {"b": ["remove"], "a": ["ego", "stop"]}
    assert list(edits) == ["b", "a"] and edits["a"].steps[1].change.at == 1.0
    assert read("edits:\n", tmp_path) == {}


def test_every_step_can_be_written_and_travels_as_a_rules_parameter(tmp_path):
    class Job(Settings):
        edit: Edit

    edit = read(EVERY_STEP, tmp_path)["it"]
    steps = edit.steps
    assert {step.kind for step in steps} == set(Step.model_fields)
    assert (steps[6].change.other, steps[7].change.name, steps[3].change.duration) == ("8b", "twin", 2.0)
    for record in (edit, Job(edit=edit)):
        text = canonical_json(record.model_dump(mode="json"))
        assert type(record).model_validate_json(text) == record
    assert canonical_json(steps[0].model_dump(mode="json")) == '{"remove":{"track":"6e5c"}}'


def test_a_missing_file_is_reported_as_missing(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: the edits file cannot be read \(No such file"):
        read_edits(tmp_path / "nowhere.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(ConfigError, match=r"binary\.yaml: the edits file is not UTF-8 text"):
        read_edits(tmp_path / "binary.yaml")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("edits: [", "edits.yaml, line 1: not YAML: expected the node content"),
        ("steps: {}", "edits.yaml: an edits file holds the one key 'edits', under it a list of steps per name"),
        ("", "edits.yaml: an edits file holds the one key 'edits'"),
        ("edits: [1]", "edits.yaml: 'edits' is [1]; it holds a list of steps per name"),
        ("edits: {}\nedits: {}", "edits.yaml, line 2: not YAML: the key 'edits' stands twice"),
        ("edits: {a: [{stop: {track: x, at: 1, at: 2}}]}", "edits.yaml, line 1: not YAML: the key 'at' stands twice"),
        ("edits: {a b: []}", "edits.yaml: edit 'a b' cannot name a file: use letters, digits, '_', '-' and '.'"),
        ("edits: {../a: []}", "edits.yaml: edit '../a' cannot name a file: use letters, digits, '_', '-' and '.'"),
        ("edits: {0103: []}", "edits.yaml: edit 67 is not text: put the name in quotes"),
        ("edits: {a: []}", "edits.yaml: edit 'a' is []; it is a list of steps, at least one: - remove: {track: 6e5c}"),
        ("edits: {a: {remove: {track: x}}}", "edits.yaml: edit 'a' is {'remove': {'track': 'x'}}; it is a"),
    ],
)  # fmt: skip
def test_a_file_of_another_form_is_refused(tmp_path, text, expected):
    assert refusal(text, tmp_path).startswith(expected)


KINDS = "remove, speed, stop, reverse, shift, swap, duplicate, place, insert, rescale, recolour, ego"
COLOURS = "at least one of 'hue', 'saturation', 'value' and 'colour'"
NAME = "cannot name a file: use letters, digits, '_', '-' and '.'"


def refused_step(step: str, folder: Path) -> str:
    """What is said of the second step of an edit, without where."""
    message = refusal(f"edits:\n  a:\n  - stop: {{track: y, at: 1}}\n  - {step}\n", folder)
    assert message.startswith("edits.yaml: edit 'a', step 2")
    return message.removeprefix("edits.yaml: edit 'a', step 2")


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        ("remove", f" is 'remove'; a step has one key, one of {KINDS}"),
        ("{remove: 1, ego: 2}", f" is {{'remove': 1, 'ego': 2}}; a step has one key, one of {KINDS}"),
        ("{delete: {track: x}}", f": there is no step 'delete'; there are: {KINDS}"),
        ("remove: x", " (remove) is 'x'; it is a mapping: remove: {track: 6e5c, ...}"),
        ("ego:", " (ego) is None; it is a mapping: ego: {lateral: 2.0}"),
        ("shift: {track: x, lateral: 3,5}",
         " (shift): 5 stands where a key should; a decimal has a point: 3.5, not 3,5"),
    ],
)  # fmt: skip
def test_what_is_no_step_is_refused_by_its_number(tmp_path, step, expected):
    assert refused_step(step, tmp_path) == expected


@pytest.mark.parametrize(
    ("kind", "fields", "expected"),
    [
        ("remove", "", "'track' is missing; there are: track"),
        ("remove", "track: 75", "'track' is 75: an id is text: put it in quotes as it stands in tracks.csv"),
        ("remove", "track: x, trak: x", "unknown key 'trak'; there are: track"),
        ("speed", "track: x", "give either 'factor' or 'to' (m/s)"),
        ("speed", "track: x, to: 1e1",
         "'to' is '1e1': input should be a number (YAML reads 1e-3 as text: write 1.0e-3)"),
        ("speed", "track: x, to: 3, duration: 2", "'duration' without 'start': say at which second the change begins"),
        ("stop", "track: x", "'at' is missing; there are: track, at, duration"),
        ("stop", "track: x, at: .nan", "'at' is nan: input should be a finite number"),
        ("reverse", "track: x, turn: 1", "'turn' is 1: input should be true or false"),
        ("shift", "track: x", "give at least one of 'lateral', 'longitudinal' and 'yaw'"),
        ("shift", "track: x, lateral: 51", "'lateral' is 51: input should be less than or equal to 50"),
        ("duplicate", "track: x, as: a/b", f"'as' 'a/b' {NAME}"),
        ("duplicate", "track: x, as: ego", "'as' 'ego' is a name kept for the camera's car; choose another"),
        ("place", "track: x, as: y, path: [[0, 1]]", "'path.0.2' is missing; there are: track, as, path, yaw, phase"),
        ("place", "track: x, as: y, path: []", "give at least one point in 'path'"),
        ("place", "track: x, as: y, path: [[1, 0, 0], [1, 5, 0]]",
         "the seconds of 'path' must increase from point to point"),
        ("recolour", "track: x", f"give {COLOURS}, other than 0, 1 and 1"),
        ("recolour", "track: x, colour: red, hue: 10",
         "'colour' replaces hue and saturation: give it alone, or with 'value'"),
        ("recolour", "track: x, from: gold", "'from' without 'colour': say which colour the paint becomes"),
        ("recolour", "track: x, from: silver, colour: red",
         "'from' is a grey: white, grey and black paint looks like tyres and glass; give 'colour' alone"),
        ("recolour", "track: x, colour: rouge", "'colour' is 'rouge': no colour has this name; give a CSS name, "
         "'#rrggbb' in quotes, or [red, green, blue] from 0 to 1"),
        ("ego", "", "give 'lateral', or a 'speed' other than 1"),
    ],
)  # fmt: skip
def test_a_step_with_other_fields_is_refused_by_its_number_and_kind(tmp_path, kind, fields, expected):
    assert refused_step(f"{kind}: {{{fields}}}", tmp_path) == f" ({kind}): {expected}"


@pytest.mark.parametrize(
    "colour", ["firebrick", "'#b22222'", "[0.6980392156862745, 0.13333333333333333, 0.13333333333333333]"]
)
def test_a_colour_is_a_name_a_number_or_three_shares(tmp_path, colour):
    step = read(f"edits: {{a: [{{recolour: {{track: x, colour: {colour}}}}}]}}", tmp_path)["a"].steps[0]
    assert step.change.colour == (178 / 255, 34 / 255, 34 / 255)


@pytest.fixture(scope="module")
def demo_actors() -> list[EditedActor]:
    """The dynamic objects of the demo's drive, at all its key frames."""
    recorder, times = Recorder(WorldSettings()), 0.5 * np.arange(20)
    return [
        EditedActor.recorded(
            instance_token("demo", thing.name), ObjectClass.CAR, thing.category, thing.size,
            Motion(times, np.stack([recorder.box_to_global(thing, t) for t in times]), ((0, 19),), 0.25),
        )
        for thing in recorder.objects
        if thing.moves and thing.category == "vehicle.car"
    ]  # fmt: skip


@pytest.mark.slow
def test_the_demos_edits_name_what_is_there_and_use_every_step(demo_actors):
    """But insertion, which needs the asset of another scene: presets/edits/cyclist.yaml."""
    edits = read_edits(DEMO)
    assert {step.kind for edit in edits.values() for step in edit.steps} == set(Step.model_fields) - {"insert"}
    for name, edit in edits.items():
        edited_drive = edited_actors(demo_actors, edit, name)
        moved = [actor for actor in edited_drive if actor.edited]
        assert moved or len(edited_drive) < len(demo_actors) or any(step.kind == "ego" for step in edit.steps), name
    assert yaml.safe_load(DEMO.read_text())["edits"].keys() == edits.keys()
