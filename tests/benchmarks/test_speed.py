"""Timed trainings: the planned trainings, the tables, and the command end to end."""

import json
import os
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import yaml
from helpers import REPOSITORY
from helpers.hand_made_recipes import table_cells
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy

from benchmarks.speed import __main__ as command
from benchmarks.speed import runs
from benchmarks.speed.compare import speed
from benchmarks.speed.cpu_load import CpuSample, busy_elsewhere
from benchmarks.speed.own_process import run_in_process
from benchmarks.speed.plan import Task, plan_run, read_speed_file, targets_of, tasks_of
from benchmarks.speed.settings import SpeedFile
from benchmarks.speed.table import markdown
from drivesplat.errors import ConfigError, TrainingError
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.settings.config import load, merged
from drivesplat.training.stage import TrainingFiles, read_inputs, run_training
from drivesplat.workflow.stages import stage_settings

pytestmark = pytest.mark.usefixtures("one_thread")
DEFAULTS = yaml.safe_load((REPOSITORY / "config.yaml").read_text(encoding="utf-8"))


def planned(tmp_path: Path, **content: Any) -> tuple[SpeedFile, list[Task]]:
    file = SpeedFile.model_validate({"scene": "0061", **content})
    return file, list(tasks_of(file, plan_run(file, tmp_path, REPOSITORY), tmp_path))


# --- files ---


def test_both_recipes_run_with_every_seed_and_length_in_alternating_order(tmp_path):
    _, tasks = planned(tmp_path, iterations=[30, 7], seeds=[4, 5])
    order = [(task.iterations, task.seed, task.recipe) for task in tasks]
    assert order[:4] == [(30, 4, "plain"), (30, 4, "ours"), (30, 5, "ours"), (30, 5, "plain")]
    assert order[4:] == [(7, *rest) for _, *rest in order[:4]]
    assert len({task.folder for task in tasks}) == 8


def test_our_recipe_has_the_settings_of_rule_train_except_length_and_seed(tmp_path):
    """Uses `street`, with the inputs that only this method reads."""
    file, tasks = planned(tmp_path, method="street", iterations=[77], seeds=[5])
    run, config = plan_run(file, tmp_path, REPOSITORY), load(DEFAULTS)
    expected = json.loads(stage_settings(config, "train", "0061", "street"))
    task = tasks[1]
    assert task.train.model_dump(mode="json") == merged(expected, {"random_seed": 5, "train": {"iterations": 77}})
    at = SimpleNamespace(scene="0061", method="street-77-seed5")
    assert json.loads(run.plan.settings("train")(at)) == task.train.model_dump(mode="json")
    assert (task.code, task.stage) == (run.plan.code("train"), "street-77-seed5/train")
    files = task.files
    assert [[*paths] for paths in (files.actors, files.lidar_depth, files.scans)] == [
        run.plan.training_input(stage)(at) for stage in ("actors", "lidar_depth", "scans")
    ]
    assert {Path(path).name for path in targets_of(run)} == {
        "scene_refined.json", "parser.npz", "masks.json", "actors.npz", "lidar_depth.npz"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[]", ["mine.yaml", "docs/speed.md"]),
        ("seeds: [0]", ["mine.yaml", "'scene' is missing"]),
        ({"scene": 61}, ["mine.yaml", "scene", "in quotes"]),
        ({"iterations": [7, 7]}, ["mine.yaml", "iterations", "twice"]),
        ({"iterations": []}, ["mine.yaml", "iterations", "at least 1"]),
        ({"seeds": [1, 1]}, ["mine.yaml", "seeds", "twice"]),
        ({"baselines": ["plain_sky"]}, ["mine.yaml", "baselines", "begins with 'plain'"]),
        ({"baselines": ["plain", "plain_sky", "plain_sky"]}, ["mine.yaml", "baselines", "twice"]),
        ({"baselines": ["plain", "mine"]}, ["mine.yaml", "baselines", "plain_packed"]),
        ({"iteration": [7]}, ["mine.yaml", "unknown key 'iteration'", "docs/speed.md"]),
        ({"config": {"results_dir": "x"}}, ["mine.yaml", "config.results_dir"]),
        ({"config": {"train": {"iteration": 3}}}, ["base and config: ", "train.iteration"]),
        ({"scene": "9999"}, ["scene '9999' is not in the config"]),
        ({"method": "vanila"}, ["method 'vanila'", "vanilla, street"]),
    ],
    ids=str,
)
def test_errors_are_reported_in_one_line(tmp_path, content, words):
    path = tmp_path / "mine.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump({"scene": "0061", **content}))
    with pytest.raises(ConfigError) as failure:
        plan_run(read_speed_file(path, {}), tmp_path / "out", REPOSITORY)
    message = str(failure.value)
    assert "\n" not in message and all(word in message for word in words), message


@pytest.mark.parametrize("path", sorted((REPOSITORY / "benchmarks/speed").glob("*.yaml")), ids=lambda path: path.name)
def test_the_shipped_files_are_valid(path, tmp_path):
    file = read_speed_file(path, {})
    assert list(tasks_of(file, plan_run(file, tmp_path, REPOSITORY), tmp_path))


# --- tables ---

PROTOCOL = {
    "version": "v1.0-mini", "cameras": ["CAM_FRONT"], "width": 640, "height": 360, "train_images": 31,
}  # fmt: skip


def ended(recipe: str, seed: int, loop: float, static: float, **more: Any) -> dict[str, Any]:
    """A run with these interpolation figures; its static extrapolation PSNR is 5 dB lower."""
    between = {"static": {"psnr": static}, "all": {"psnr": static - 1.0, "ssim": 0.5}, "moving_vehicle": None}
    result = {"interpolation": between, "extrapolation": {"static": {"psnr": static - 5.0}, "all": None}}
    costs = {"gaussians": 1000 + seed, "peak_gpu_memory_gb": 2.5, "loop": loop, "whole": 2.0 * loop}
    return {
        "recipe": recipe, "iterations": 300, "seed": seed, "device": "NVIDIA H200", "processors": 16, "cap_max": 5000,
        "busy_elsewhere": 0.5, "dataset": "nuscenes", "protocol": PROTOCOL, "result": result, "curve": [], **costs,
        **({"ssim": "fused_ssim"} if recipe != "ours" else {}), **more,
    }  # fmt: skip


RUNS = [ended("plain", 0, 60.0, 20.0), ended("ours", 0, 30.0, 22.0), ended("ours", 1, 20.0, 25.0)]
RUNS += [ended("plain", 1, 50.0, 22.0)]
TWO = SpeedFile(scene="0061", seeds=(0, 1), iterations=(300, 700), profiled=10)


def test_the_table_gives_times_with_the_quality_reached():
    """Loops of 60 and 50 s against 30 and 20 s: 2 and 2.5 times as fast. Static PSNR: +2 and +3."""
    record = speed(TWO, RUNS, [])
    (table,) = record["tables"]
    assert (table["iterations"], table["seeds"]) == (300, [0, 1]), "no table of what has not been run"
    fast = table["rows"][1]["times_as_fast"]
    assert fast["loop"]["by_seed"] == [2.0, 2.5] == fast["whole"]["by_seed"]
    assert table["rows"][0]["times_as_fast"] is None
    assert table["rows"][1]["iterations_per_second"]["by_seed"] == [10.0, 15.0]
    assert table["rows"][1]["interpolation"]["difference"]["static"]["by_seed"] == [2.0, 3.0]
    between, beyond = table_cells(markdown(record))
    assert between[0] == [
        "recipe", "loop", "whole", "iterations/s", "times as fast", "Gaussians", "GPU memory", "static", "difference",
        "all", "difference",
    ]  # fmt: skip
    assert between[2] == [
        "`plain`", "55.0 (50.0 to 60.0) s", "110 (100 to 120) s", "5.5", "-", "1,000", "2.5 GB",
        "21.0 (20.0 to 22.0)", "-", "20.0 (19.0 to 21.0)", "-",
    ]  # fmt: skip
    assert between[3] == [
        "`vanilla`", "25.0 (20.0 to 30.0) s", "50.0 (40.0 to 60.0) s", "12.5", "2.25 (2.00 to 2.50)", "1,000", "2.5 GB",
        "23.5 (22.0 to 25.0)", "+2.50 ± 0.50", "22.5 (21.0 to 24.0)", "+2.50 ± 0.50",
    ]  # fmt: skip
    assert beyond[3] == ["`vanilla`", "18.5 (17.0 to 20.0)", "+2.50 ± 0.50", "-", "-"]
    assert json.loads(json.dumps(record, allow_nan=False)) == record and record["runs"] == RUNS


def test_the_table_gives_the_time_to_quality():
    """The plain recipe is within 0.3 dB of its best, 21.0, half-way between its stops; the method reaches that value
    after 2 s with one seed, and never with the other."""
    curves = [[(10.0, 20.4), (20.0, 21.0), (30.0, 20.9)], [(2.0, 21.0), (4.0, 24.0), (6.0, 25.0)]]
    curves += [[(2.0, 20.0), (4.0, 21.0)], [(10.0, 22.0)]]
    runs_of = [
        {**run, "curve": [{"iteration": 10 * i, "seconds": s, "static": psnr} for i, (s, psnr) in enumerate(of, 1)]}
        for run, of in zip(RUNS, curves, strict=True)
    ]
    (one,) = speed(TWO.model_copy(update={"seeds": (0,)}), runs_of, [])["tables"]
    plain, ours = (row["time_to_quality"] for row in one["rows"])
    assert (plain["best"]["mean"], plain["near_best"]["mean"], plain["best_of_plain"]["mean"]) == (21.0, 15.0, 20.0)
    assert (ours["best"]["mean"], ours["best_of_plain"]["mean"]) == (25.0, 2.0)
    assert ours["near_best"]["mean"] == pytest.approx(4.0 + 2.0 * 0.7)
    record = speed(TWO.model_copy(update={"visits": 3}), runs_of, [])
    (table,) = record["tables"]
    assert table["rows"][1]["time_to_quality"]["best_of_plain"] is None, "one seed does not reach it"
    page = markdown(record)
    assert "at 3 stops of each training" in page
    assert ["`vanilla`", "23.0 (21.0 to 25.0)", "4.4 (3.4 to 5.4) s", "-"] in table_cells(page)[2]
    assert "Time to quality" not in markdown(speed(TWO, RUNS, []))


def shares(**of: tuple[float, float]) -> dict[str, dict[str, float]]:
    return {name: {"device_ms": device, "host_ms": host} for name, (device, host) in of.items()}


def test_the_table_compares_stages_by_their_share_of_the_iteration():
    plain = shares(data=(1.0, 1.0), render=(2.0, 2.0), other=(1.0, 1.0), iteration=(4.0, 4.0))
    ours = shares(render=(1.0, 1.0), checks=(0.5, 0.5), other=(0.5, 0.5), iteration=(2.0, 2.0))
    profiles = [{"recipe": "plain", "iterations": 300, "stages": plain}]
    profiles += [{"recipe": "ours", "iterations": 300, "stages": ours}]
    text = markdown(speed(TWO, RUNS, profiles))
    assert "over 10 iterations that continue from the trained models of seed 0" in text
    *_, stages = table_cells(text)
    assert stages[0] == ["stage", "`plain`", "`vanilla`"]
    assert stages[2:] == [
        ["render", "2.00 (50%)", "1.00 (50%)"], ["checks", "-", "0.50 (25%)"], ["data", "1.00 (25%)", "-"],
        ["other", "1.00 (25%)", "0.50 (25%)"], ["iteration", "4.00", "2.00"],
    ]  # fmt: skip


# --- runs ---


def test_the_load_of_other_processes_is_measured():
    """In 10 s two processors worked 18 s, 6 s of these for this process: the rest is the load of 1.2 processors."""
    assert busy_elsewhere(CpuSample(5.0, 100.0, 2.0), CpuSample(15.0, 118.0, 8.0)) == pytest.approx(1.2)
    assert busy_elsewhere(CpuSample(5.0, None, 2.0), CpuSample(15.0, None, 8.0)) is None
    assert busy_elsewhere(CpuSample(5.0, 100.0, 2.0), CpuSample(15.0, 101.0, 8.0)) == 0.0, "its own, counted twice"


def test_a_killed_training_is_reported_in_one_line():
    with pytest.raises(TrainingError, match=r"was killed, .* lower train\.cap_max"):
        run_in_process(os._exit, 1)


TINY = {
    "base": ["mine.yaml"],
    "scene": "0001",
    "iterations": [12],
    "seeds": [4],
    "profiled": 6,
    "baselines": ["plain", "plain_sky"],
    "visits": 3,
    "workers": 0,
    "config": {"train": {**TINY_TRAINING, "gaussians": {"sh_degree": 3}}},
}


@pytest.mark.slow
@pytest.mark.workflow
def test_the_command_trains_and_measures_all_recipes_as_rule_train_does(tmp_path, monkeypatch):
    """Equal settings and files give the same model as the function that the rule calls."""
    copy = WorkflowCopy.make(tmp_path / "copy")
    (copy.folder / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    monkeypatch.chdir(copy.folder)
    monkeypatch.setattr(command, "run_in_process", lambda function, *args: function(*args))
    assert command.main(["tiny.yaml", "--", "--cores", "2"]) == 0
    record = copy.read("results/speed/tiny/speed.json")
    (table,) = record["tables"]
    plain, _, ours = table["rows"]
    for row in table["rows"]:
        assert row["extrapolation"]["static"]["mean"] > 5.0, "it was measured"
        assert 0.0 < row["loop"]["mean"] <= row["whole"]["mean"]
        assert row["gaussians"]["mean"] > 0 and row["peak_gpu_memory_gb"] is None
    assert plain["gaussians"] == ours["gaussians"], "the same seed points, the same cap, no growth in 12 iterations"
    assert plain["extrapolation"]["static"]["mean"] != ours["extrapolation"]["static"]["mean"]
    fast = plain["loop"]["mean"] / ours["loop"]["mean"]
    assert ours["times_as_fast"]["loop"]["mean"] == pytest.approx(fast)
    assert list(table["stages"]) == ["plain", "plain_sky", "ours"]
    for stages in table["stages"].values():
        assert {"data", "render", "loss", "backward", "optimizer", "densification", "other"} < set(stages)
        assert stages["backward"]["device_ms"] > stages["data"]["device_ms"] > 0
    for run in record["runs"]:
        assert [point["iteration"] for point in run["curve"]] == [4, 8, 12]
        assert 0.0 < run["curve"][0]["seconds"] < run["curve"][1]["seconds"] <= run["loop"]
        if run["recipe"] != "ours":
            group = next(group for group in run["result"].values() if group["static"])
            assert run["curve"][-1]["static"] == pytest.approx(group["static"]["psnr"], abs=1e-4), "as in metrics.json"
    page = (copy.folder / "results/speed/tiny/speed.md").read_text(encoding="utf-8")
    assert page == markdown(record) and "| `plain` |" in page and "| `vanilla` |" in page

    script = (REPOSITORY / "workflow_scripts/train.py").read_text()
    assert re.search(r"^from drivesplat\.training\.stage import .*\brun_training$", script, re.MULTILINE)
    assert runs.run_training is run_training and runs.read_inputs is read_inputs
    file, out = read_speed_file("tiny.yaml", {}), Path("results/speed/tiny")
    *_, task = tasks_of(file, plan_run(file, out, Path()), out)
    timed = read_checkpoint(task.folder / "checkpoint.npz")
    inputs, _ = read_inputs(task.files.parser, [task.files.masks], (), (), ())
    files = TrainingFiles(tmp_path / "again/checkpoint.npz", tmp_path / "again/train.json")
    run_training(inputs, task.train, task.device, files, timed.provenance, "again")
    again = read_checkpoint(files.checkpoint)
    assert again.job == timed.job and all(torch.equal(value, again.model[name]) for name, value in timed.model.items())


def test_the_packed_recipe_is_refused_without_a_gpu_before_anything_is_trained(tmp_path, monkeypatch):
    file = SpeedFile(scene="demo", baselines=("plain", "plain_packed"))
    monkeypatch.setattr(command, "visible_gpus", lambda: 0)
    with pytest.raises(ConfigError, match="plain_packed needs a GPU"):
        command.measure(file, tmp_path, (), REPOSITORY, cards=0)
