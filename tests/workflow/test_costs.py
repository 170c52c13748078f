"""Costs: what benchmark files and trainings tell of jobs that have run, a row each, and what scenes come to."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers import REPOSITORY
from helpers.reports import NO_LOGS, expecting

from drivesplat.io.storage import write_json
from drivesplat.report.files import report_page
from drivesplat.report.gaps import gap_report
from drivesplat.workflow.costs.measured import read_costs
from drivesplat.workflow.costs.run_costs import COSTS, RunCosts
from drivesplat.workflow.costs.table import LIMIT_SECONDS, costs_in_words, costs_record, scene_totals, write_costs
from drivesplat.workflow.plan import Plan

HEADER = "s\th:m:s\tmax_rss\tmax_vms\tmax_uss\tmax_pss\tio_in\tio_out\tmean_load\tcpu_time"


def benchmark(results: Path, name: str, seconds: float | str, rss: str = "500.0") -> Path:
    """A benchmark file as Snakemake writes it."""
    path = results / "benchmarks" / f"{name}.tsv"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{HEADER}\n{seconds}\t0:00:10\t{rss}\t1.0\t1.0\t1.0\t0.1\t0.1\t80.00\t12.5\n")
    return path


def trained(results: Path, scene: str, method: str, seconds: float, **more: Any) -> Path:
    """What train.json says of a training, as far as costs go."""
    content = {
        "seconds": seconds, "iterations": 15000, "resumed_at": [], "peak_gpu_memory_gb": 2.5, "device": "NVIDIA H200",
    }  # fmt: skip
    path = results / scene / method / "train.json"
    write_json(path, content | more)
    return path


def test_there_is_a_row_for_every_job_that_ran(tmp_path):
    benchmark(tmp_path, "0103/extract", 3.5)
    benchmark(tmp_path, "0103/street/train", 260.0)
    benchmark(tmp_path, "0103/street/film_original", 20.0)
    benchmark(tmp_path, "gap_report", 1.0)
    trained(tmp_path, "0103", "street", 245.0)
    write_costs(tmp_path, ["street"])
    with open(tmp_path / "costs.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["scene"], row["method"], row["stage"], row["film"], float(row["seconds"])) for row in rows] == [
        ("", "", "gap_report", "", 1.0),
        ("0103", "", "extract", "", 3.5),
        ("0103", "street", "film", "original", 20.0),
        ("0103", "street", "train", "", 260.0),
    ]
    assert rows[3] | {"seconds": ""} == {
        "scene": "0103", "method": "street", "stage": "train", "film": "", "seconds": "", "seconds_from": "benchmark",
        "max_rss_mb": "500.0", "cpu_seconds": "12.5", "mean_load": "80.0", "gpu_memory_gb": "2.5",
        "device": "NVIDIA H200", "scene_under_90_minutes": "true",
    }  # fmt: skip
    assert rows[0]["scene_under_90_minutes"] == rows[0]["gpu_memory_gb"] == ""


@pytest.mark.parametrize(("minutes", "under"), [(89, True), (91, False)])
def test_a_scene_is_found_under_90_minutes_or_not(tmp_path, minutes, under):
    """By the sum of its own stages and those of its methods; what an ablation trains is no part of it."""
    benchmark(tmp_path, "0103/masks", 60.0)
    benchmark(tmp_path, "0103/vanilla/train", 60.0 * (minutes - 31))
    benchmark(tmp_path, "0103/street/train", 60.0 * 30)
    benchmark(tmp_path, "0103/street-no_sky-seed0/train", LIMIT_SECONDS)
    benchmark(tmp_path, "0103/ablation", LIMIT_SECONDS)
    benchmark(tmp_path, "0061/masks", 1.0)
    costs, _ = read_costs(tmp_path)
    short, long = scene_totals(costs, ["vanilla", "street"])
    assert (short["scene"], short["under_90_minutes"], short["complete"]) == ("0061", True, False)
    assert (long["scene"], long["under_90_minutes"], long["complete"]) == ("0103", under, True)
    assert long["seconds"] == pytest.approx(60.0 * minutes) and long["scene_seconds"] == 60.0
    assert long["seconds_by_method"] == {"vanilla": 60.0 * (minutes - 31), "street": 1800.0}
    assert long["training_seconds"] == pytest.approx(60.0 * (minutes - 1))
    report = gap_report([], expecting("0103"), NO_LOGS)
    page = report_page(report, {}, [short, long])
    assert f"<td>{minutes}.0</td>" in page and f"<td>{'yes' if under else 'no'}</td>" in page
    assert "<td>yes, so far</td>" in page and "Costs" not in report_page(report, {})
    printed = costs_in_words(costs_record(tmp_path, ["vanilla", "street"]))
    assert f"0103: {minutes}.0 min, {'under' if under else 'not under'} 90" in printed and "so far, under 90" in printed


def test_what_is_missing_or_garbled_is_named_and_left_out(tmp_path):
    benchmark(tmp_path, "0103/extract", 3.0, rss="NA")
    broken = [benchmark(tmp_path, f"0103/{name}", "NA") for name in ("masks", "parser", "actors")]
    broken[1].write_text("")
    broken[2].write_bytes(b"\xff\xfe\x00s\tx\n")
    benchmark(tmp_path, "0103/street/train", 50.0)
    broken.append(trained(tmp_path, "0103", "street", 45.0))
    broken[3].write_text('{"seconds": 4')
    alone = trained(tmp_path, "0103", "vanilla", 33.0)
    costs, complaints = read_costs(tmp_path)
    assert {(cost.job.method, cost.job.stage, cost.seconds) for cost in costs} == {
        ("", "extract", 3.0), ("street", "train", 50.0), ("vanilla", "train", 33.0)
    }  # fmt: skip
    assert all(cost.max_rss_mb is None for cost in costs if cost.job.stage == "extract")
    assert len(complaints) == 5
    assert all(any(str(path) in line for line in complaints) for path in [*broken, alone])
    assert "only the training loop's seconds" in next(line for line in complaints if str(alone) in line)
    record = write_costs(tmp_path, ["street", "vanilla"])
    assert json.loads((tmp_path / "costs.json").read_text()) == record and record["unreadable"] == complaints


def test_costs_that_cannot_be_estimated_or_written_end_no_run(tmp_path, capsys):
    (tmp_path / "costs.csv").mkdir()
    config = yaml.safe_load((REPOSITORY / "config.yaml").read_text()) | {"results_dir": str(tmp_path)}
    of_run = RunCosts(Plan(config, str(REPOSITORY)), None, [COSTS])
    of_run.begin()
    of_run.end()
    printed = capsys.readouterr().err
    assert "the run cannot be estimated" in printed and "costs are not written" in printed
