"""What is taken for a result of a recipe once Snakemake has ended, and what is said where there is none."""

import json
import logging
import tempfile
import time
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.hand_made_recipes import evaluation, recipe_file, write_evaluation

from drivesplat.workflow.job import job
from benchmarks.quality.results import Result, occupation, results_of
from benchmarks.quality.runs import Outcome, outcome, passed_on
from drivesplat.errors import ConfigError
from drivesplat.settings.device import DeviceSettings

WELL = Outcome(0, None, {})
FAILED = """\
Building DAG of jobs...
[Sat Nov 21 20:30:16 2026]
rule train:
    output: out/plain/0061/b-seed1/checkpoint.pt
drivesplat: waits for a GPU: jobs hold all there are (1; processes 7)
drivesplat: b-seed1/train 0061: out of GPU memory with 9,000 Gaussians (peak 7.1 GB): lower train.cap_max
Logfile out/plain/logs/0061/b-seed1/train.log:
================================================================================
2026-11-21 20:30:20,123 INFO drivesplat.workflow.gpus: runs on the GPU 0 (GPU-1)
2026-11-21 20:31:20,123 ERROR drivesplat.workflow.job: b-seed1/train 0061: out of GPU memory: lower it
================================================================================
"""
OF_THE_SCENE = """\
localrule extract:
2026-11-21 20:31:20,123 ERROR drivesplat.workflow.job: extract 0061: no such table: samples
2026-11-21 20:31:22,123 ERROR drivesplat.workflow.job: demo_world_demo: KeyError: 'x' (a bug; the traceback is in w.log)
"""
REFUSED = "Using profile profiles/default.\ndrivesplat: dataset nuscenes: there is no folder nowhere\n"
NO_CORES = "usage: snakemake [-h]\nsnakemake: error: argument --cores: expected one argument\n\n"


def test_a_failed_job_is_told_of_the_method_it_belongs_to():
    ended = outcome(1, FAILED)
    assert ended.why("b-seed1") == "train: out of GPU memory: lower it"
    assert ended.why("b-seed0") is ended.why("a-b-seed1") is None
    assert outcome(1, FAILED.replace("b-seed1/", "a-b-seed1/")).why("b-seed1") is None
    assert (
        outcome(1, FAILED.replace("ERROR drivesplat.workflow.job", "INFO drivesplat.workflow.job")).why("b-seed1")
        is None
    )


def test_what_fails_of_the_scene_fails_for_all_methods():
    ended = outcome(1, OF_THE_SCENE)
    assert ended.why("a-seed0") == ended.why("b-seed1") == "extract: no such table: samples"
    assert ended.failures["demo_world_demo"].startswith("KeyError: 'x'")
    both = outcome(1, OF_THE_SCENE + FAILED)
    assert both.why("b-seed1").startswith("train: ") and both.why("a-seed0").startswith("extract: ")


@pytest.mark.parametrize(
    ("output", "why"),
    [
        (REFUSED, "dataset nuscenes: there is no folder nowhere"),
        (NO_CORES, "snakemake: error: argument --cores: expected one argument"),
        ("", "nothing was said"),
    ],
)
def test_a_run_that_starts_nothing_is_told_by_its_last_word(output, why):
    assert outcome(1, output).why("a-seed0") == why
    assert outcome(0, output).why("a-seed0") is None, "nothing had to be done"


def test_warnings_of_jobs_are_no_refusal():
    killed = "\n".join(line for line in FAILED.splitlines() if "memory" not in line)
    assert outcome(1, killed) == Outcome(1, None, {})


def test_what_recipes_decide_is_not_left_to_snakemakes_arguments():
    assert passed_on(["--cores", "4", "--resources", "gpu=4", "--scheduler", "greedy"])
    assert not passed_on(["--cores", "4", "-n"])
    for arguments, words in (
        (["--configfile", "a.yaml"], "base"),
        (["--config", "sweeps=true"], "config"),
        (["--cores", "4", "results/0061/metrics.json"], "recipes"),
        (["--directory", "x"], "--out"),
    ):
        with pytest.raises(ConfigError, match=words):
            passed_on(arguments)


@pytest.fixture
def groups(tmp_path):
    """Two recipes in one group, and a third in a group of its own."""
    recipes = {"a": {}, "b": {"overrides": {"sky": "mask"}}, "c": {"config": {"sweeps": True}}}
    return recipe_file(tmp_path, recipes=recipes)[1]


def ended(groups, *outcomes: Outcome) -> dict[tuple[str, int], Result]:
    found = results_of(list(zip(groups, outcomes or (WELL, WELL), strict=True)))
    return {(result.recipe, result.seed): result for result in found}


def test_every_recipe_and_seed_has_its_own_figures_or_a_reason(groups):
    both, alone = groups
    for psnr, (group, recipe, seed) in enumerate([(both, "a", 0), (both, "a", 1), (alone, "c", 1)]):
        write_evaluation(group, recipe, seed, evaluation(20.0 + psnr))
    found = ended(groups, outcome(1, FAILED), outcome(1, REFUSED))
    static = {key: r.result and r.result["interpolation"]["static"]["psnr"] for key, r in found.items()}
    assert static == {("a", 0): 20.0, ("a", 1): 21.0, ("b", 0): None, ("b", 1): None, ("c", 0): None, ("c", 1): 22.0}
    assert found["b", 1].why.startswith("train: out of GPU memory")
    assert "no reason given" in found["b", 0].why and "b-seed0/train.log" in found["b", 0].why
    assert found["c", 0].why == "dataset nuscenes: there is no folder nowhere"
    assert found["a", 0].why == ""


def test_figures_of_earlier_settings_or_code_do_not_count(groups):
    """A training that fails leaves eval.json of the one before it in place."""
    both, _ = groups
    for recipe, seed, change in (("a", 0, None), ("a", 1, "settings"), ("b", 0, "code"), ("b", 1, "settings")):
        path = write_evaluation(both, recipe, seed, evaluation(20.0))
        content = json.loads(path.read_text())
        train = content["provenance"]["stages"][f"{recipe}-seed{seed}/train"]
        if change == "settings":
            train["settings"]["train"]["iterations"] = 3
        elif change == "code":
            train["code"] = "other"
        path.write_text(json.dumps(content))
    found = ended(groups, outcome(1, FAILED), WELL)
    assert found["a", 0].result and not any(found[key].result for key in (("a", 1), ("b", 0), ("b", 1)))
    assert "a-seed1/train: train.iterations is 3 in the result, 15000 now" in found["a", 1].why
    assert "b-seed0/train: other code" in found["b", 0].why
    assert found["b", 1].why.startswith("train: out of GPU memory"), "why it was not made anew comes first"


@pytest.mark.parametrize("content", ['{"provenance": ', "[]", '{"provenance": {}}', '{"provenance": null}'])
def test_a_file_that_is_no_evaluation_is_named(groups, content):
    path = write_evaluation(groups[0], "a", 0, evaluation(20.0))
    path.write_text(content)
    result = ended(groups)["a", 0]
    assert result.result is None and str(path) in result.why and "'evaluate'" in result.why


def write_log(group, recipe: str, seed: int, began: str, finished: str, card: str | None, stage: str = "train") -> Path:
    """What a job logs that had its card from `began` on; for a card it has waited since nine."""
    path = group.log(recipe, seed, stage)
    path.parent.mkdir(parents=True, exist_ok=True)
    took = f"2026-11-21 {began},000 INFO drivesplat.workflow.gpus: runs on the GPU 0 ({card})\n" if card else ""
    name = f"{recipe}-seed{seed}/{stage} 0061"
    started = "09:00:00" if card else began
    path.write_text(
        f"2026-11-21 {started},000 INFO drivesplat.workflow.job: {name} begins\n{took}a line of a traceback\n"
        f"2026-11-21 {finished},000 INFO drivesplat.workflow.job: {name} ends\n"
    )
    return path


@pytest.fixture
def own_logging():
    """A root logger without handlers, which a script configures for its process, and afterwards the one there was."""
    root = logging.getLogger()
    handlers, level, root.handlers[:] = root.handlers[:], root.level, []
    yield
    logging.captureWarnings(False)
    root.handlers[:] = handlers
    root.setLevel(level)


def test_the_log_of_a_job_says_which_card_it_had_and_when(tmp_path, monkeypatch, own_logging):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-8f2e")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    path = tmp_path / "train.log"
    empty = SimpleNamespace(input=None, output=None, wildcards=SimpleNamespace(scene="0061", method="a-seed0"))
    resources = SimpleNamespace(device=DeviceSettings().model_dump_json())
    before = datetime.now()
    with job(
        SimpleNamespace(**vars(empty), threads=1, rule="train", params=None, resources=resources, log=[path])
    ) as at:
        at.device()
        time.sleep(0.02)
    held = occupation(path.read_text(), on_processors=False)
    assert held.card == "GPU-8f2e"
    millisecond = timedelta(milliseconds=1)
    assert before - millisecond <= held.began < held.ended - 10 * millisecond < datetime.now()


@pytest.mark.parametrize(
    ("others", "shared"),
    [
        ({}, False),
        ({"b": ("10:05:00", "10:15:00", "GPU-1", "train")}, True),
        ({"b": ("10:05:00", "10:06:00", "GPU-1", "evaluate")}, True),
        ({"b": ("10:05:00", "10:15:00", "GPU-2", "train")}, False),
        ({"b": ("10:10:00", "10:15:00", "GPU-1", "train")}, False),
        ({"c": ("09:50:00", "10:00:01", "GPU-1", "train")}, True),
        ({"a": ("10:05:00", "10:15:00", "GPU-1", "evaluate")}, False),
    ],
    ids=str,
)
def test_trainings_that_shared_a_card_are_told_by_their_logs(groups, others, shared):
    """One card belongs to training a from 10:00 to 10:10; a job of another group may be on it, too."""
    both, alone = groups
    write_evaluation(both, "a", 0, evaluation(20.0))
    write_log(both, "a", 0, "10:00:00", "10:10:00", "GPU-1")
    for recipe, (began, finished, card, stage) in others.items():
        write_log(alone if recipe == "c" else both, recipe, 0, began, finished, card, stage)
    assert ended(groups)["a", 0].shared is shared


@pytest.mark.parametrize(("device", "shared"), [("cpu (x86_64)", True), ("NVIDIA H200", False)])
def test_processors_are_shared_where_no_card_is_named(groups, device, shared):
    """A GPU without a name in the log is one that a scheduler gave: which, nobody knows."""
    for recipe in ("a", "b"):
        write_evaluation(groups[0], recipe, 0, evaluation(20.0, device=device))
        write_log(groups[0], recipe, 0, "10:00:00", "10:10:00", None)
    assert ended(groups)["a", 0].shared is ended(groups)["b", 0].shared is shared
