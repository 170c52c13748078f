"""Old names of settings: they hold for one version, wherever a config has them, and planning says what they are now."""

import json
import os
from typing import Any

import pytest
import yaml
from helpers import REPOSITORY
from helpers.forked_snakemake import run_snakemake
from helpers.patience import PATIENCE_S

from drivesplat.errors import ConfigError
from drivesplat.settings.config import Config, for_scene, in_current_names, load
from drivesplat.settings.method import merged
from drivesplat.settings.removed import FORMER_DEFAULTS
from drivesplat.settings.renamed import RENAMED

DEFAULTS = yaml.safe_load((REPOSITORY / "config.yaml").read_text(encoding="utf-8"))


def at(path: str, value: Any) -> dict[str, Any]:
    """{a: {b: value}} of a path 'a.b'."""
    for key in reversed(path.split(".")):
        value = {key: value}
    return value


def value_at(tree: dict[str, Any], path: str) -> Any:
    for key in path.split("."):
        tree = tree[key]
    return tree


def new_path(old: str) -> str:
    return f"{old.rpartition('.')[0]}.{RENAMED[old]}"


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_name_sets_the_setting_of_its_new_name(old):
    default = value_at(Config().model_dump(), new_path(old))
    other = default + 20 if isinstance(default, int) else default / 2
    assert load(merged(DEFAULTS, at(old, other))) == load(merged(DEFAULTS, at(new_path(old), other))) != Config()
    current, (note,) = in_current_names(at(old, other))
    assert current == at(new_path(old), other)
    assert note.endswith(f": {old} (now {RENAMED[old]})")


@pytest.mark.parametrize(
    "where", ["datasets.nuscenes.overrides", "methods.street.overrides", "ablation.without.sky.overrides"]
)
def test_overrides_may_have_old_names(where):
    old = "train.coarse_to_fine.share"
    config = merged(DEFAULTS, at(f"{where}.{old}", 0.5))
    assert load(config) == load(merged(DEFAULTS, at(f"{where}.{new_path(old)}", 0.5)))
    assert in_current_names(config)[1][0].endswith(f": {where}.{old} (now fraction)")


def test_an_old_name_holds_over_the_default_of_the_new_one_in_config_yaml():
    """As where a file of the last version is laid over config.yaml, which has the new name."""
    values = at("datasets.demo.overrides.train.checkpoint_apart_s", 7.0)
    train = for_scene(load(merged(DEFAULTS, values)), "demo").train
    assert train.min_checkpoint_interval_s == 7.0
    assert value_at(DEFAULTS, "datasets.demo.overrides.train.min_checkpoint_interval_s") == 10.0


def test_a_new_name_that_was_changed_and_an_old_one_are_refused_in_a_sentence():
    both = {"train": {"actors": {"min_gaussians": 300, "least": 400}}}
    with pytest.raises(ConfigError) as error:
        load(both)
    assert str(error.value) == (
        "'train.actors.least' is the old name of 'train.actors.min_gaussians', and both are set (400 and 300): drop "
        "the old one"
    )
    assert load({"train": {"actors": {"min_gaussians": 400, "least": 400}}}).train.actors.min_gaussians == 400


def test_a_whole_config_of_the_last_version_gives_the_same_settings():
    """config.yaml had every setting then, and a user may have kept it."""
    whole = json.loads(Config().model_dump_json())
    for old in RENAMED:
        section = value_at(whole, old.rpartition(".")[0])
        section[old.rpartition(".")[2]] = section.pop(RENAMED[old])
    demo = whole["datasets"]["demo"]["overrides"]["train"]
    demo["checkpoint_apart_s"] = demo.pop("min_checkpoint_interval_s")
    for method in whole["methods"].values():
        del method["of"]
    for key, default in FORMER_DEFAULTS.items():
        whole = merged(whole, at(key, default))
    before = json.dumps(whole)
    assert load(whole) == load(merged(DEFAULTS, whole)) == Config()
    assert json.dumps(whole) == before, "the config as read stays as it is"
    names, removed = in_current_names(whole)[1]
    assert names.count("(now ") == len(RENAMED) + 1
    assert removed.endswith(", ".join(FORMER_DEFAULTS)) and removed.startswith(
        "removed settings, which the next version"
    )


def test_planning_says_which_names_are_old(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("train: {checkpoint_apart_s: 5, coarse_to_fine: {least_height: 100}}\n")
    command = [
        "-n",
        "-s",
        str(REPOSITORY / "Snakefile"),
        "-d",
        str(tmp_path),
        "--cores",
        "1",
        "--configfile",
        str(file),
    ]
    done = run_snakemake([*command, "--", "results/demo/metrics.json"], REPOSITORY, os.environ, PATIENCE_S)
    said = [line for line in done.stdout.splitlines() if "old names" in line]
    assert said == [
        "drivesplat: old names of settings, which the next version will refuse: train.checkpoint_apart_s (now "
        "min_checkpoint_interval_s), train.coarse_to_fine.least_height (now min_height)"
    ]
    assert done.returncode == 0, done.stdout
