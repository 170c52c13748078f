"""Which files count as a recipe's result after Snakemake has ended, and the reasons for missing ones."""

import json
import logging
import shutil
import tempfile
import time
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.hand_made_recipes import evaluation, recipe_file, write_evaluation, write_failure

from drivesplat.workflow.job import job
from benchmarks.quality.results import Result, collect_results, device_use
from benchmarks.snakemake_run import Outcome, is_dry_run, refusal
from drivesplat.errors import ConfigError
from drivesplat.settings.device import DeviceSettings

WELL = Outcome(0)
STARTED = """\
Building DAG of jobs...
[Sat Nov 21 20:30:16 2026]
rule train:
    output: out/plain/0061/b-seed1/checkpoint.npz
drivesplat: waits for a GPU: jobs hold all there are (1; processes 7)
"""
REFUSED = "Using profile profiles/default.\ndrivesplat: dataset nuscenes: there is no folder nowhere\n"
NO_CORES = "usage: snakemake [-h]\nsnakemake: error: argument --cores: expected one argument\n\n"


@pytest.mark.parametrize(
    ("output", "reason"),
    [
        (REFUSED, "dataset nuscenes: there is no folder nowhere"),
        (NO_CORES, "snakemake: error: argument --cores: expected one argument"),
        ("", "Snakemake ended without a message"),
        (STARTED, None),
    ],
)
def test_the_reason_of_a_run_without_jobs_is_its_last_message(output, reason):
    """A message of a started job, such as waiting for a GPU, is not an error."""
    assert refusal(output.splitlines(keepends=True)) == reason


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


def test_a_failure_of_an_earlier_call_is_ignored(runs):
    path = fails(runs[0], "a", 0)
    assert ended(runs)["a", 0].reason.startswith("train: ")
    later = Outcome(1, "another run is working", path.stat().st_mtime + 1.0)
    assert ended(runs, later, WELL)["a", 0].reason == "another run is working"


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
        if change == "settings":
            train["settings"]["train"]["iterations"] = 3
        elif change == "code":
            train["code"] = "other"
        path.write_text(json.dumps(content))
    fails(both, "b", 1)
    found = ended(runs)
    assert found["a", 0].figures and not any(found[key].figures for key in (("a", 1), ("b", 0), ("b", 1)))
    assert "a-seed1/train: train.iterations is 3 in the result, 7000 now" in found["a", 1].reason
    assert "b-seed0/train: other code" in found["b", 0].reason
    assert found["b", 1].reason.startswith("train: out of GPU memory"), "the failure comes first"


@pytest.mark.parametrize("content", ['{"provenance": ', "[]", '{"provenance": {}}', '{"provenance": null}'])
def test_an_invalid_evaluation_file_is_named(runs, content):
    path = write_evaluation(runs[0], "a", 0, evaluation(20.0))
    path.write_text(content)
    result = ended(runs)["a", 0]
    assert result.figures is None and str(path) in result.reason and "'evaluate'" in result.reason


def write_log(run, recipe: str, seed: int, began: str, finished: str, gpu: str | None, stage: str = "train") -> Path:
    """Writes the log of a job that held its GPU from `began` on, after waiting for it since nine o'clock."""
    path = run.log(recipe, seed, stage)
    path.parent.mkdir(parents=True, exist_ok=True)
    took = f"2026-11-21 {began},000 INFO drivesplat.workflow.gpus: runs on the GPU 0 ({gpu})\n" if gpu else ""
    name = f"{recipe}-seed{seed}/{stage} 0061"
    started = "09:00:00" if gpu else began
    path.write_text(
        f"2026-11-21 {started},000 INFO drivesplat.workflow.job: {name} begins\n{took}a line of a traceback\n"
        f"2026-11-21 {finished},000 INFO drivesplat.workflow.job: {name} ends\n"
    )
    return path


@pytest.fixture
def own_logging():
    """Removes the root logger's handlers, so that a script can configure them, and restores them afterwards."""
    root = logging.getLogger()
    handlers, level, root.handlers[:] = root.handlers[:], root.level, []
    yield
    logging.captureWarnings(False)
    root.handlers[:] = handlers
    root.setLevel(level)


def test_a_job_log_gives_its_gpu_and_the_time_it_held_it(tmp_path, monkeypatch, own_logging):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-8f2e")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    path = tmp_path / "train.log"
    empty = SimpleNamespace(input=[], output=[], wildcards=SimpleNamespace(scene="0061", method="a-seed0"))
    resources = SimpleNamespace(device=DeviceSettings().model_dump_json())
    before = datetime.now()
    with job(
        SimpleNamespace(**vars(empty), threads=1, rule="train", params=None, resources=resources, log=[path])
    ) as at:
        at.device()
        time.sleep(0.02)
    held = device_use(path.read_text(), on_processors=False)
    assert held.device == "GPU-8f2e"
    millisecond = timedelta(milliseconds=1)
    assert before - millisecond <= held.start < held.end - 10 * millisecond < datetime.now()


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
def test_trainings_that_shared_a_gpu_are_recognised_from_their_logs(runs, others, shared):
    """Training a holds one GPU from 10:00 to 10:10; a job of another run may use it as well."""
    both, alone = runs
    write_evaluation(both, "a", 0, evaluation(20.0))
    write_log(both, "a", 0, "10:00:00", "10:10:00", "GPU-1")
    for recipe, (began, finished, gpu, stage) in others.items():
        write_log(alone if recipe == "c" else both, recipe, 0, began, finished, gpu, stage)
    assert ended(runs)["a", 0].shared is shared


@pytest.mark.parametrize(("device", "shared"), [("cpu (x86_64)", True), ("NVIDIA H200", False)])
def test_without_a_gpu_name_only_cpu_trainings_count_as_shared(runs, device, shared):
    """A GPU without a name in the log was assigned by a scheduler and is unknown."""
    for recipe in ("a", "b"):
        write_evaluation(runs[0], recipe, 0, evaluation(20.0, device=device))
        write_log(runs[0], recipe, 0, "10:00:00", "10:10:00", None)
    assert ended(runs)["a", 0].shared is ended(runs)["b", 0].shared is shared
