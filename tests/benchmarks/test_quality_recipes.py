"""Recipe files: one-line errors, recipes that share a run, and the settings of each."""

import json
from typing import Any

import pytest
import yaml
from helpers import REPOSITORY

from benchmarks.quality.recipes import plan_runs, read_recipes
from benchmarks.snakemake_run import SnakemakeRun
from drivesplat.errors import ConfigError
from drivesplat.settings.config import load
from drivesplat.workflow.stages import stage_settings

DEFAULTS = yaml.safe_load((REPOSITORY / "config.yaml").read_text(encoding="utf-8"))
PLAIN = {"scene": "0061", "seeds": [0, 1], "recipes": {"vanilla": {"of": "vanilla"}, "street": {"of": "street"}}}


@pytest.fixture
def runs(tmp_path):
    """Writes a recipe file and plans its runs."""

    def read(content: Any = None, **more: Any) -> list[SnakemakeRun]:
        path = tmp_path / "mine.yaml"
        path.write_text(content if isinstance(content, str) else yaml.safe_dump({**PLAIN, **more}, sort_keys=False))
        return plan_runs(read_recipes(path), tmp_path / "out", REPOSITORY)

    return read


def settings_of(run: SnakemakeRun, stage: str, method: str | None = None) -> dict[str, Any]:
    return json.loads(stage_settings(run.plan.config, stage, run.scene, method))


def test_every_recipe_is_planned_with_every_seed_and_otherwise_the_settings_of_its_method(runs, tmp_path):
    (run,) = runs()
    names = ["vanilla-seed0", "vanilla-seed1", "street-seed0", "street-seed1"]
    assert list(run.plan.config.all_methods) == names
    folder = tmp_path / "out/plain/0061"
    assert run.targets == [folder / name / "eval.json" for name in names]
    assert run.log("street", 1, "train") == tmp_path / "out/plain/logs/0061/street-seed1/train.log"
    config = load(DEFAULTS)
    for name in ("vanilla", "street"):
        expected = json.loads(stage_settings(config, "train", "0061", name))
        assert settings_of(run, "train", f"{name}-seed1") == expected | {"random_seed": 1}


def test_parts_and_overrides_replace_those_of_the_base_method(runs):
    recipes = {
        "bare": {"of": "street", "parts": ["background"], "overrides": {"sky": "none", "train": {"depth_weight": 0.0}}},
        "own": {"parts": ["background", "actors"]},
    }
    (run,) = runs(recipes=recipes)
    bare, own = settings_of(run, "train", "bare-seed0"), settings_of(run, "train", "own-seed0")
    assert (bare["parts"], bare["sky"], bare["train"]["depth_weight"]) == (["background"], "none", 0.0)
    assert bare["train"]["sky_bce_weight"] == 0.05, "street's own, which the recipe leaves alone"
    assert own["parts"] == ["background", "actors"]
    assert (own["sky"], own["train"]["sky_bce_weight"]) == ("cubemap", 0.0), "of nothing: the settings of the config"


def test_recipes_share_a_folder_where_their_scene_is_the_same(runs, tmp_path):
    recipes = {
        "street": {"of": "street"},
        "swept": {"of": "street", "config": {"sweeps": True}},
        "vanilla": {"of": "vanilla"},
        "vanilla_swept": {"of": "vanilla", "config": {"sweeps": True}},
        "small": {"of": "street", "config": {"images": {"width": 320}, "lidar_seed": {"far_points": 0}}},
    }
    made = runs(recipes=recipes)
    assert [run.methods for run in made] == [("street", "vanilla"), ("swept", "vanilla_swept"), ("small",)]
    assert [settings_of(run, "extract")["sweeps"] for run in made] == [False, True, False]
    assert [settings_of(run, "lidar_seed")["lidar_seed"]["far_points"] for run in made] == [80_000, 80_000, 0]
    plain, swept, small = (run.folder.relative_to(tmp_path / "out").as_posix() for run in made)
    assert plain == "plain" and swept.startswith("sweeps-") and small.startswith("images-lidar_seed-")
    alone = runs(recipes={"renamed": recipes["small"], "other": recipes["swept"]})
    assert {run.folder.name for run in alone} == {small, swept}, "folders depend on no other recipe"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("recipes: [", ["mine.yaml", "not YAML"]),
        ("scene: '0061'\nrecipes: {a: {}, a: {}}", ["mine.yaml", "'a' stands twice"]),
        ("[]", ["mine.yaml", "docs/quality.md"]),
        ({"scene": 49}, ["mine.yaml", "scene", "in quotes", "octal"]),
        ({"scene": "9999"}, ["scene '9999' is not in the config"]),
        ({"recipe": {}}, ["mine.yaml", "unknown key 'recipe'", "docs/quality.md"]),
        ("scene: '0061'", ["mine.yaml", "'recipes' is missing"]),
        ({"recipes": {}}, ["mine.yaml", "recipes", "at least 1"]),
        ({"recipes": {"a": None}}, ["mine.yaml", "recipes", "keep one"]),
        ({"recipes": {"a/b": {}}}, ["mine.yaml", "recipe 'a/b'", "letters"]),
        ({"recipes": {"a": {"train": {}}}}, ["mine.yaml", "'recipes.a.train'"]),
        ({"recipes": {"a": {"of": "vanila"}}}, ["'a'", "'vanila'", "vanilla, street"]),
        ({"recipes": {"a": {"parts": ["actors"]}}}, ["recipes.a.parts", "lacks 'background'"]),
        ({"recipes": {"a": {"overrides": {"holdout": {}}}}}, ["recipes.a.overrides.holdout", "sky, train"]),
        ({"recipes": {"a": {"overrides": {"train": {"iteration": 3}}}}}, ["recipe a: ", "train.iteration"]),
        ({"recipes": {"a": {"config": {"train": {"iterations": 3}}}}}, ["recipes.a.config.train", "holdout"]),
        ({"recipes": {"a": {"config": {"results_dir": "x"}}}}, ["recipes.a.config.results_dir"]),
        ({"recipes": {"a": {"config": {"lidar_seed": {"points": 3}}}}}, ["recipe a: ", "lidar_seed.points"]),
        ({"config": {"ablation": {}}}, ["mine.yaml", "'config.ablation'"]),
        ({"config": {"holdout": {"every_nth": -1}}}, ["base and config: ", "holdout.every_nth", "-1"]),
        ({"base": ["nowhere.yaml"]}, ["nowhere.yaml", "config file cannot be read"]),
        ({"seeds": [1, 1]}, ["mine.yaml", "seeds", "twice"]),
        ({"seeds": []}, ["mine.yaml", "seeds", "at least 1"]),
    ],
    ids=str,
)
def test_errors_are_reported_in_one_line(runs, content, words):
    with pytest.raises(ConfigError) as failure:
        runs(content) if isinstance(content, str) else runs(**content)
    message = str(failure.value)
    assert "\n" not in message and all(word in message for word in words), message


@pytest.mark.parametrize(
    "again",
    [{"of": "vanilla"}, {"overrides": {"train": {"actors": {"fourier": 1}}}}, {"config": {"sweeps": False}}],
    ids=str,
)
def test_recipes_with_identical_trainings_are_refused(runs, again):
    """Vanilla has no actors; no sweeps are the default."""
    with pytest.raises(ConfigError, match="'vanilla' and 'again' train the same on scene 0061"):
        runs(recipes={"vanilla": {}, "again": again})


@pytest.mark.parametrize("path", sorted((REPOSITORY / "benchmarks/recipes").glob("*.yaml")), ids=lambda path: path.name)
def test_the_shipped_recipe_files_are_valid(path, tmp_path, monkeypatch):
    monkeypatch.chdir(REPOSITORY)
    assert plan_runs(read_recipes(path), tmp_path, REPOSITORY)
