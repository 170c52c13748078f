"""The table of recipes: its content, its notes, and the command end to end."""

import json
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from math import sqrt
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers import REPOSITORY
from helpers.hand_made_recipes import PROTOCOL, evaluation, recipe_file, table_cells, write_evaluation, write_failure
from helpers.patience import PATIENCE_S
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy

from benchmarks.quality.__main__ import main
from benchmarks.quality.compare import quality
from benchmarks.quality.recipes import RecipeFile
from benchmarks.quality.results import collect_results
from benchmarks.quality.table import markdown
from benchmarks.snakemake_run import Outcome, SnakemakeRun

BAD = {"overrides": {"sky": "none"}}


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Makes a record of recipes from eval.json contents by name and seed; all others have failed."""

    @cache
    def planned(recipes: str) -> tuple[RecipeFile, list[SnakemakeRun]]:
        return recipe_file(tmp_path_factory.mktemp("planned"), recipes=json.loads(recipes))

    def compare(evals: dict[str, list[dict[str, Any] | None]], recipes: dict[str, Any]) -> dict[str, Any]:
        file, runs = planned(json.dumps(recipes))
        for run in runs:
            shutil.rmtree(run.folder, ignore_errors=True)
            for recipe in run.methods:
                for seed, content in enumerate(evals[recipe]):
                    if content:
                        write_evaluation(run, recipe, seed, content)
                    else:
                        write_failure(
                            run.log(recipe, seed, "train"), f"{recipe}-seed{seed}/train 0061", "a loss | no number"
                        )
        return quality(file, collect_results([(run, Outcome(0)) for run in runs]))

    return compare


TWO = {"plain": {}, "street": {"of": "street"}}
EVALS = {
    "plain": [evaluation(24.0, 18.0, ssim=0.7), evaluation(25.0, 17.0, ssim=0.8)],
    "street": [
        evaluation(25.0, 22.0, gaussians=3000, train_seconds=90.0),
        evaluation(27.0, 21.0, gaussians=2000, train_seconds=130.0, peak_gpu_memory_gb=3.5),
    ],
}


def test_the_table_compares_recipes_with_the_first_one_per_group_and_by_cost(compared):
    """Static PSNR 24 and 25 against 25 and 27: differences +1 and +2, mean 1.5, standard error 0.5."""
    record = compared(EVALS, TWO)
    (table,) = record["tables"]
    plain, street = table["rows"]
    assert (table["reference"], plain["recipe"], street["recipe"]) == ("plain", "plain", "street")
    assert plain["interpolation"]["difference"]["static"] is None and record["failed"] == []
    off = street["interpolation"]["difference"]["static"]
    assert (off["mean"], off["by_seed"]) == (1.5, [1.0, 2.0])
    assert off["standard_error"] == pytest.approx(sqrt(0.5) / sqrt(2.0))
    assert street["interpolation"]["gap_db"]["by_seed"] == [3.0, 6.0]
    assert street["extrapolation"]["static"]["by_seed"] == [20.0, 22.0]
    assert (street["peak_gpu_memory_gb"]["mean"], street["train_seconds"]["max"]) == (3.0, 130.0)
    between, beyond, costs = table_cells(markdown(record))
    assert between[0] == ["recipe", "static", "difference", "moving vehicles", "difference", "gap", "SSIM"]
    assert between[2] == ["`plain`", "24.5 (24.0 to 25.0)", "-", "17.5 (17.0 to 18.0)", "-", "7.0", "0.750"]
    assert between[3] == [
        "`street`", "26.0 (25.0 to 27.0)", "+1.50 ± 0.50", "21.5 (21.0 to 22.0)", "+4.00 ± 0.00", "4.5", "0.500",
    ]  # fmt: skip
    assert beyond[3] == ["`street`", "21.0 (20.0 to 22.0)", "+1.50 ± 0.50", "-", "-", "-"]
    assert costs[3] == [
        "`street`", "0, 1", "31", "no", "nuscenes", "15,000", "2,500", "110 s", "3.0 GB", "NVIDIA H200",
    ]  # fmt: skip


def test_figures_against_the_truth_have_tables_of_their_own(compared):
    evals = json.loads(json.dumps(EVALS))
    for seed, content in enumerate(evals["street"]):
        left = {"static": {"psnr": 20.0 + seed}, "moving_vehicle": None, "depth": None}
        depth = {"median_relative_error": 0.01 + 0.02 * seed}
        right = {"static": {"psnr": 22.0 + seed}, "moving_vehicle": {"psnr": 18.0}, "depth": depth}
        removal = {"box": {"psnr": 17.0 + seed}, "not_removed": {"box": {"psnr": 12.0}}}
        content["result"] |= {"lateral": {"4.0": left, "-2.0": right}, "removal": removal}
    record = compared(evals, TWO)
    plain, street = (row["truth"] for row in record["tables"][0]["rows"])
    assert plain == {"lateral": {}, "side_camera": {}, "removal": {"removed": None, "not_removed": None}}
    assert street["lateral"]["-2.0"]["static"]["by_seed"] == [22.0, 23.0]
    page = markdown(record)
    *_, lateral, removal, _ = table_cells(page)
    assert lateral[0] == ["recipe", "view", "static", "moving vehicles", "depth error"]
    assert lateral[2:] == [
        ["`street`", "2 m to the right", "22.5 (22.0 to 23.0)", "18.0 (18.0 to 18.0)", "2.0%"],
        ["`street`", "4 m to the left", "20.5 (20.0 to 21.0)", "-", "-"],
    ]
    assert removal[2:] == [["`street`", "17.5 (17.0 to 18.0)", "12.0 (12.0 to 12.0)"]]
    assert "beside the recorded path" in page and "beside the recorded path" not in markdown(compared(EVALS, TWO))


OTHERWISE = {
    "width": {"width": 320},
    "holdout": {"holdout": {"every_nth": 4, "offset": 4, "last_block": 4}, "held_out_frames": {"interpolation": [4, 8],
                "extrapolation": [35, 36]}},
    "eval_camera": {"eval_camera": "CAM_BACK"},
    "regions": {"regions": "masks"},
    "own_car": {"own_car": "outline"},
    "version": {"version": "v1.0-trainval"},
    "key_frame_range": {"key_frame_range": [0, 20]},
}  # fmt: skip


def test_results_measured_under_another_protocol_get_their_own_table(compared):
    evals = {**EVALS, **{key: [evaluation(30.0, protocol=changed)] * 2 for key, changed in OTHERWISE.items()}}
    others = {key: {"overrides": {"train": {"iterations": 100 + i}}} for i, key in enumerate(OTHERWISE)}
    record = compared(evals, {"plain": TWO["plain"], **others, "street": TWO["street"]})
    recipes = [[row["recipe"] for row in table["rows"]] for table in record["tables"]]
    assert recipes == [["plain", "street"], *([key] for key in OTHERWISE)]
    text = markdown(record)
    notes = [line for line in text.splitlines() if line.startswith("The protocol differs from")]
    for key, table, note in zip(OTHERWISE, record["tables"][1:], notes, strict=True):
        assert table["rows"][0]["interpolation"]["difference"]["static"] is None, "to itself alone"
        usual = yaml.safe_dump(PROTOCOL[key], default_flow_style=True, sort_keys=False).split("\n")[0]
        assert f"{key} " in note and usual in note
        assert text.count(f"Difference from `{key}`") == 1


def test_a_failed_recipe_is_listed_and_recorded_with_its_reason_beside_the_figures_of_the_others(compared):
    record = compared({**EVALS, "bad": [None, None]}, {**TWO, "bad": BAD})
    assert [(item["recipe"], item["seed"]) for item in record["failed"]] == [("bad", 0), ("bad", 1)]
    between, beyond, costs = table_cells(markdown(record))
    assert between[4] == ["`bad`", r"failed: train: a loss \| no number", "", "", "", "", ""] and len(beyond) == 5
    assert [line[0] for line in costs[2:]] == ["`plain`", "`street`"]
    assert "- `bad`, seed 1: train: a loss | no number" in markdown(record)
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    seeds = {name: [run["seed"] for run in runs] for name, runs in record["runs"].items()}
    assert seeds == {"plain": [0, 1], "street": [0, 1], "bad": [0, 1]}
    run = record["runs"]["street"][1]
    assert run["result"] == EVALS["street"][1]["result"] and run["protocol"] == PROTOCOL
    assert "street-seed1/train" in run["provenance"]["stages"] and record["runs"]["bad"][0]["result"] is None
    assert (record["scene"], record["seeds"], record["recipes"]["bad"]["overrides"]) == (
        "0061",
        [0, 1],
        {"sky": "none"},
    )


def test_the_command_passes_arguments_to_snakemake_and_writes_page_and_record(tmp_path, monkeypatch, capsys):
    """A fake Snakemake writes the results."""
    recipe_file(tmp_path, recipes=TWO)
    passed: list[str] = []

    def start(run: SnakemakeRun, arguments: list[str], workflow: Path) -> Outcome:
        passed.extend(arguments)
        for recipe, contents in EVALS.items():
            for seed, content in enumerate(contents):
                write_evaluation(run, recipe, seed, content)
        return Outcome(0)

    monkeypatch.setattr(SnakemakeRun, "start", start)
    monkeypatch.chdir(REPOSITORY)
    words = ["--cores", "4", "--resources", "gpu=2"]
    assert main([str(tmp_path / "recipes.yaml"), "--out", str(tmp_path / "out"), "--", *words]) == 0 and passed == words
    page = (tmp_path / "out/quality.md").read_text(encoding="utf-8")
    record = json.loads((tmp_path / "out/quality.json").read_text())
    assert page == markdown(record) and page in capsys.readouterr().out


# --- from end to end ---

RECIPES = {
    "base": ["mine.yaml"],
    "scene": "0001",
    "seeds": [4],
    "config": {"train": {**TINY_TRAINING, "iterations": 3, "log_every": 1}},
    "recipes": {
        "elsewhere": {"config": {"datasets": {"nuscenes": {"dataroot": "nowhere"}}}},
        "vanilla": {"of": "vanilla"},
        "broken": {"overrides": {"train": {"opacity_reg": 1.0e300}}},
    },
}


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.xdist_group("quality")
def test_recipes_run_to_a_table_with_failures_and_only_failed_ones_run_again(tmp_path):
    """One recipe has no data, one diverges, the third is measured. A second call runs only the failed ones."""
    copy = WorkflowCopy.make(tmp_path / "copy")
    (copy.folder / "recipes.yaml").write_text(yaml.safe_dump(RECIPES, sort_keys=False))
    done = command(copy)
    assert done.returncode == 1, done.stdout
    record = copy.read("results/quality/recipes/quality.json")
    reasons = {item["recipe"]: item["why"] for item in record["failed"]}
    assert set(reasons) == {"elsewhere", "broken"} and "nowhere" in reasons["elsewhere"], reasons
    assert reasons["broken"].startswith("train: ") and "iteration" in reasons["broken"]
    (row,) = record["tables"][0]["rows"]
    measured = copy.read("results/quality/recipes/plain/0001/vanilla-seed4/eval.json")["result"]
    assert (row["recipe"], row["train_iterations"], measured["random_seed"]) == ("vanilla", 3, 4)
    assert row["extrapolation"]["static"]["by_seed"] == [measured["extrapolation"]["static"]["psnr"]]
    page = (copy.folder / "results/quality/recipes/quality.md").read_text(encoding="utf-8")
    assert page in done.stdout and "| `vanilla` |" in page and "| `broken` | failed: train: " in page
    assert {"extract", "lidar_seed", "parser", "masks", "train", "evaluate"} <= ran(done.stdout)

    again = command(copy)
    assert again.returncode == 1 and ran(again.stdout) == {"train"}, again.stdout
    assert copy.read("results/quality/recipes/quality.json")["tables"] == record["tables"]


def command(copy: WorkflowCopy) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.quality", "recipes.yaml", "--", "--cores", "2"],
        cwd=copy.folder,
        env={**os.environ, "PYTHONPATH": "", "CUDA_VISIBLE_DEVICES": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE_S,
    )


def ran(output: str) -> set[str]:
    """The rules of which Snakemake started a job."""
    return set(re.findall(r"^(?:local)?rule (\w+):$", output, re.M))
