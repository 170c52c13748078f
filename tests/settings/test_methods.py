"""Methods that build on others: what they inherit, and that equal methods rerun nothing."""

from typing import Any

import pytest
import yaml
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.settings.config import load
from drivesplat.settings.method import MethodSettings, merged
from drivesplat.workflow.stages import stage_settings

DEFAULTS = yaml.safe_load((REPOSITORY / "config.yaml").read_text(encoding="utf-8"))
STREET = {"train": DEFAULTS["methods"]["street"]["overrides"]["train"]}


def methods_of(methods: dict[str, Any], base: dict[str, Any] = DEFAULTS) -> dict[str, MethodSettings | None]:
    return load(merged(base, {"methods": methods})).methods


def refusal(methods: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as error:
        methods_of(methods)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_method_inherits_what_it_does_not_give_and_replaces_or_merges_what_it_gives():
    overrides = {"sky": "none", "train": {"road": {"reach": 0.2}, "dropout": 0.0}}
    given = {
        "same": {"of": "street"},
        "static": {"of": "street", "parts": ["background"], "tracks": "none"},
        "merged": {"of": "street", "overrides": overrides},
    }
    made = methods_of(given)
    found = {name: (made[name].parts, made[name].tracks, made[name].overrides) for name in (*given, "street")}
    base, road = (("background", "road", "actors"), "annotated", STREET), {"surface": "lidar", "reach": 0.2}
    over = {"sky": "none", "train": {**STREET["train"], "road": road, "dropout": 0.0}}
    assert found == {
        "same": base, "static": (("background",), "none", STREET), "merged": (*base[:2], over), "street": base
    }  # fmt: skip


@pytest.mark.parametrize("order", [["a", "b", "c"], ["c", "b", "a"]])
def test_chains_are_followed_whatever_the_order(order):
    chain = {
        "a": {"of": "street", "overrides": {"train": {"iterations": 5}}},
        "b": {"of": "a", "parts": ["background", "deformable"], "overrides": {"train": {"iterations": 6}}},
        "c": {"of": "b", "overrides": {"train": {"lr_sky": 0.5}}},
    }
    made = methods_of({name: chain[name] for name in order})["c"]
    assert made.parts == ("background", "deformable")
    assert made.overrides == {"train": {**STREET["train"], "iterations": 6, "lr_sky": 0.5}}


def test_a_changed_base_changes_the_methods_that_are_of_it():
    changed = {"street": {"overrides": {"train": {"dropout": 0.5}}}, "mine": {"of": "street"}}
    made = methods_of(changed)["mine"]
    assert made is not None and made.overrides["train"]["dropout"] == 0.5


def test_a_method_can_be_of_a_shipped_one_that_is_dropped():
    """A preset of a method that is of `street` still works where a file drops `street`."""
    made = methods_of({"street": None, "vanilla": None, "mine": {"of": "street"}})
    assert list(made) == ["mine"] and made["mine"].overrides == STREET


@pytest.mark.parametrize(
    ("methods", "message"),
    [
        ({"first": None, "mine": {"of": "first"}}, "'first', which is no method of the config; "),
        ({"mine": {"of": "stret"}}, "'stret', which is no method of the config; did you mean street? "),
    ],
    ids=["dropped", "misspelled"],
)
def test_a_method_of_one_that_there_is_none_of_is_refused_with_those_there_are(methods, message):
    assert refusal(methods) == f"method 'mine' is of {message}there are: vanilla, street, mine"


@pytest.mark.parametrize(
    ("methods", "circle"),
    [
        ({"a": {"of": "a"}}, "'a' of 'a'"),
        ({"a": {"of": "b"}, "b": {"of": "a"}}, "'a' of 'b' of 'a'"),
        ({"x": {"of": "a"}, "a": {"of": "b"}, "b": {"of": "a"}}, "'a' of 'b' of 'a'"),
        ({"street": {"of": "vanilla"}, "vanilla": {"of": "street"}}, "'vanilla' of 'street' of 'vanilla'"),
    ],
)
def test_circles_are_refused(methods, circle):
    assert refusal(methods) == f"methods cannot be of each other in a circle: {circle}"


@pytest.mark.parametrize(
    ("method", "words"),
    [
        ({"of": "street", "parts": ["actors"]}, ["methods.mine.parts", "lacks 'background'"]),
        ({"of": "street", "parts": None}, ["methods.mine.parts", "must be a list"]),
        ({"of": "street", "tracks": "none"}, ["methods.mine", "tracks: none leaves the part 'actors'"]),
        ({"of": "street", "overrides": {"train": {"iteration": 5}}}, ["methods.mine.overrides", "train.iteration"]),
        ({"of": "street", "overrides": {"holdout": {}}}, ["methods.mine.overrides.holdout", "cannot be set"]),
        ({"of": "street", "overrides": 5}, ["methods.mine.overrides", "must be a mapping"]),
        ({"of": "street", "part": ["background"]}, ["unknown key 'methods.mine.part'"]),
        ({"of": 5}, ["methods.mine.of", "this text is a number to YAML"]),
    ],
    ids=str,
)
def test_an_invalid_method_of_another_is_refused_at_its_own_place(method, words):
    message = refusal({"mine": method})
    assert all(word in message for word in words), message


def test_an_equal_method_has_equal_settings_however_it_is_written():
    """Snakemake compares these texts: a method that is rewritten with `of` reruns nothing."""
    people = {"train": {"deformable": {"fourier": 2}}}
    written_out = {"parts": ["background", "actors", "deformable"], "overrides": merged(STREET, people)}
    built = {"of": "street", "parts": ["background", "actors", "deformable"], "overrides": people}
    for stage in ("train", "evaluate", "export_viewer"):
        texts = {
            stage_settings(load(merged(DEFAULTS, {"methods": {"mine": method}})), stage, "demo", "mine")
            for method in (written_out, built)
        }
        assert len(texts) == 1


def test_the_ablation_takes_the_method_as_built():
    config = load(merged(DEFAULTS, {"methods": {"mine": {"of": "street"}}, "ablation": {"of": "mine", "seeds": [7]}}))
    complete = config.ablated["mine-seed7"]
    assert complete.parts == ("background", "road", "actors") and complete.overrides == {**STREET, "random_seed": 7}


PRESETS = {
    "lidar": ("street_lidar", ("background", "road", "actors"), "annotated", ("flatness_weight", "gaussians", "scans")),
    "people": ("street_people", ("background", "road", "actors", "deformable"), "annotated", ()),
    "off_the_lane": (
        "street_aside", ("background", "road", "actors"), "annotated", ("antialiased", "smoothness_weight", "floaters"),
    ),
    "without_boxes": ("street_discovered", ("background", "road", "actors"), "discovered", ()),
}  # fmt: skip


@pytest.mark.parametrize("preset", PRESETS)
def test_the_methods_of_presets_are_street_and_what_they_add(preset):
    name, parts, tracks, added = PRESETS[preset]
    values = yaml.safe_load((REPOSITORY / f"presets/{preset}.yaml").read_text())
    method = load(merged(DEFAULTS, values)).methods[name]
    assert method is not None and (method.parts, method.tracks) == (parts, tracks)
    assert set(method.overrides) == {"train"} and set(method.overrides["train"]) == {*STREET["train"], *added}
    assert method.overrides["train"].items() >= STREET["train"].items()
