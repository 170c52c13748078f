"""Which files count as a recipe's result after Snakemake has ended, and the reasons for missing ones."""

import json
import shutil
from pathlib import Path

import pytest
from helpers.hand_made_recipes import evaluation, recipe_file, write_evaluation, write_failure

from benchmarks.quality.results import Result, collect_results
from benchmarks.snakemake_run import Outcome, is_dry_run, refusal
from drivesplat.errors import ConfigError

WELL = Outcome(0)
REFUSED = "Using profile profiles/default.\ndrivesplat: dataset nuscenes: there is no folder nowhere\n"


def test_arguments_that_the_recipe_file_sets_are_refused():
    assert not is_dry_run(["--cores", "4", "--resources", "gpu=4", "--scheduler", "greedy"])
    assert is_dry_run(["--cores", "4", "-n"])
    for arguments, words in (
        (["--configfile", "a.yaml"], "base"),
        (["--config", "sweeps=true"], "config"),
        (["--cores", "4", "results/0061/metrics.json"], "the file's content"),
        (["--directory", "x"], "--out"),
    ):
        with pytest.raises(ConfigError, match=words):
            is_dry_run(arguments)


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """Two recipes in one run, and a third in a run of its own."""
    recipes = {"a": {}, "b": {"overrides": {"sky": "mask"}}, "c": {"config": {"sweeps": True}}}
    return recipe_file(tmp_path_factory.mktemp("planned"), recipes=recipes)[1]


@pytest.fixture
def runs(planned):
    """The same, without results."""
    for run in planned:
        shutil.rmtree(run.folder, ignore_errors=True)
    return planned


def ended(runs, *outcomes: Outcome) -> dict[tuple[str, int], Result]:
    found = collect_results(list(zip(runs, outcomes or (WELL, WELL), strict=True)))
    return {(result.recipe, result.seed): result for result in found}


def fails(run, recipe: str, seed: int, reason: str = "out of GPU memory: lower it", **level: str) -> Path:
    return write_failure(run.log(recipe, seed, "train"), f"{recipe}-seed{seed}/train 0061", reason, **level)


def test_a_failed_job_is_the_reason_for_its_own_method_only(runs):
    both, _ = runs
    fails(both, "b", 1)
    fails(both, "a", 1, level="INFO")
    found = ended(runs)
    assert found["b", 1].reason == "train: out of GPU memory: lower it"
    for key in (("b", 0), ("a", 0), ("a", 1), ("c", 1)):
        assert "no reason given" in found[key].reason
    assert f"{both.log('b', 0, 'train')}" in found["b", 0].reason


@pytest.mark.parametrize("place", ["0061/extract", "demo_world/demo"])
def test_a_scene_failure_is_the_reason_for_all_methods_without_their_own(runs, place):
    both, _ = runs
    stage = Path(place).name
    write_failure(both.logs / f"{place}.log", f"{stage} 0061", "no such table: samples")
    fails(both, "b", 1)
    found = ended(runs)
    assert found["a", 0].reason == found["b", 0].reason == f"{stage}: no such table: samples"
    assert found["b", 1].reason.startswith("train: ") and "no reason given" in found["c", 0].reason


def test_every_recipe_and_seed_has_its_own_figures_or_a_reason(runs):
    both, alone = runs
    for psnr, (run, recipe, seed) in enumerate([(both, "a", 0), (both, "a", 1), (alone, "c", 1)]):
        write_evaluation(run, recipe, seed, evaluation(20.0 + psnr))
    fails(both, "b", 1)
    found = ended(runs, Outcome(1), Outcome(1, refusal(REFUSED.splitlines())))
    static = {key: r.figures and r.figures["interpolation"]["static"]["psnr"] for key, r in found.items()}
    assert static == {("a", 0): 20.0, ("a", 1): 21.0, ("b", 0): None, ("b", 1): None, ("c", 0): None, ("c", 1): 22.0}
    assert found["b", 1].reason.startswith("train: out of GPU memory")
    assert "no reason given" in found["b", 0].reason and "b-seed0/train.log" in found["b", 0].reason
    assert found["c", 0].reason == "dataset nuscenes: there is no folder nowhere"
    assert found["a", 0].reason == ""


def test_figures_of_earlier_settings_or_code_do_not_count(runs):
    """A failed training leaves the eval.json of the previous training in place."""
    both, _ = runs
    for recipe, seed, change in (("a", 0, None), ("a", 1, "settings"), ("b", 0, "code"), ("b", 1, "settings")):
        path = write_evaluation(both, recipe, seed, evaluation(20.0))
        content = json.loads(path.read_text())
        train = content["provenance"]["stages"][f"{recipe}-seed{seed}/train"]
        train["settings"]["train"] |= {"iterations": 3} if change == "settings" else {}
        train |= {"code": "other"} if change == "code" else {}
        path.write_text(json.dumps(content))
    fails(both, "b", 1)
    found = ended(runs)
    assert found["a", 0].figures and not any(found[key].figures for key in (("a", 1), ("b", 0), ("b", 1)))
    assert "a-seed1/train: train.iterations is 3 in the result, 7000 now" in found["a", 1].reason
    assert "b-seed0/train: other code" in found["b", 0].reason
    assert found["b", 1].reason.startswith("train: out of GPU memory"), "the failure comes first"
