"""The report across scenes: rows and means of what is current and comparable; the rest is named, never mixed in."""

import copy
import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.reports import NO_LOGS, PROTOCOL, expecting, group, method, metrics, report_job, report_of, stages

from drivesplat.report.files import console_table, report_page
from drivesplat.report.gaps import gap_report, summary_sentences
from drivesplat.report.tables import gap_table, write_figures

METHODS = ("vanilla", "street")
VANILLA_A = method(group(24.0, 17.0, 21.0, lpips=0.3), group(22.0, 14.0), gaussians=1000, seconds=60.0)
VANILLA_B = method(group(26.0, None, 22.0, lpips=0.1), group(23.0), gaussians=3000, seconds=80.0)


@pytest.fixture
def write(tmp_path):
    """Writes a metrics.json where the workflow does, and returns its path."""

    def write_metrics(record: dict | str, scene: str | None = None) -> str:
        path = tmp_path / (scene or record["scene"]) / "metrics.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(record if isinstance(record, str) else json.dumps(record))
        return str(path)

    return write_metrics


FIGURES = (
    "moving_vehicle", "static", "vehicle", "gap_db", "moving_human", "human_gap_db", "psnr", "psnr_frame_mean", "ssim",
    "lpips",
)  # fmt: skip


def test_a_row_has_the_figures_of_both_groups(tmp_path):
    report = report_of(tmp_path, metrics("0061", {"vanilla": VANILLA_A}), methods=("vanilla",))
    figures = {
        "interpolation": (17.0, 24.0, 19.0, 7.0, None, None, 23.0, 23.0, 0.8, 0.3),
        "extrapolation": (14.0, 22.0, 14.0, 8.0, None, None, 21.0, 21.0, 0.8, None),
    }
    (row,) = report["rows"]
    assert row == {
        **{f"{key}_{name}": psnr for key, own in figures.items() for name, psnr in zip(FIGURES, own, strict=True)},
        "scene": "0061", "dataset": "nuscenes", "method": "vanilla", "tracks": "annotated", "gaussians": 1000,
        "train_seconds": 60.0, "shown": None,
    }  # fmt: skip
    assert report["left_out"] == report["missing"] == [] and report["partial"] is False
    assert report["schema"] == 3 and report["protocols"] == {"0061": PROTOCOL}


def test_people_have_a_gap_of_their_own(tmp_path):
    """In the rows, the means, the table and the page; reports without people do not mention them."""
    walking = method(group(30.0, 28.0, people=19.5), group(24.0))
    with_people = report_of(tmp_path, metrics("0061", {"vanilla": walking}), methods=("vanilla",))
    (row,), (mean,) = with_people["rows"], with_people["means"]
    assert (row["interpolation_moving_human"], row["interpolation_human_gap_db"]) == (19.5, 10.5)
    assert row["extrapolation_human_gap_db"] is None and row["interpolation_gap_db"] == 2.0
    assert mean["figures"]["interpolation_human_gap_db"]["mean"] == 10.5
    assert "people" in gap_table(with_people) and "Moving people" in report_page(with_people, {})
    without = report_of(tmp_path, metrics("0061", {"vanilla": VANILLA_A}), methods=("vanilla",))
    assert "people" not in gap_table(without) and "Moving people" not in report_page(without, {})


def test_means_are_over_scenes_per_method_and_ignore_null(tmp_path):
    a, b = (metrics(scene, {"vanilla": vanilla, "street": VANILLA_B})
            for scene, vanilla in (("0061", VANILLA_A), ("0103", VANILLA_B)))  # fmt: skip
    means = report_of(tmp_path, a, b, methods=METHODS)["means"]
    assert [mean["method"] for mean in means] == ["vanilla", "street"]
    vanilla, street = ({name: found and found["mean"] for name, found in mean["figures"].items()} for mean in means)
    assert vanilla["interpolation_static"] == 25.0
    assert vanilla["interpolation_moving_vehicle"] == 17.0, "of the one scene where something moves"
    assert vanilla["interpolation_gap_db"] == 7.0, "where nothing moves the gap is that of parked vehicles"
    assert vanilla["extrapolation_vehicle"] == 14.0
    assert vanilla["interpolation_lpips"] == pytest.approx(0.2) and vanilla["extrapolation_lpips"] is None
    assert (vanilla["gaussians"], vanilla["train_seconds"]) == (2000, 70.0)
    assert street["extrapolation_moving_vehicle"] is None
    assert means[0]["figures"]["interpolation_gap_db"]["scenes"] == 1


def left_out(report: dict[str, Any], scene: str) -> str:
    (why,) = [item["why"] for item in report["left_out"] if item["scene"] == scene]
    assert "\n" not in why
    return why


def test_a_result_of_other_settings_code_or_of_no_configured_scene_is_left_out_and_named_with_the_difference(write):
    paths = [
        write(metrics("0061", {"vanilla": VANILLA_A})),
        write(metrics("0103", {"vanilla": VANILLA_B}, stages(iterations=7000))),
        write(metrics("0553", {"vanilla": VANILLA_A}, stages(code="old"))),
        write(metrics("0655", {"vanilla": VANILLA_A})),
    ]
    report = gap_report(paths, expecting("0061", "0103", "0553", "0757"), NO_LOGS)
    assert [row["scene"] for row in report["rows"]] == ["0061"]
    assert report["means"][0]["figures"]["interpolation_static"]["mean"] == 24.0, "what is left out counts in no mean"
    assert all(word in left_out(report, "0103") for word in ("vanilla/train", "train.iterations", "7000", "30000"))
    assert "vanilla/train: other code" in left_out(report, "0553")
    assert "config" in left_out(report, "0655")
    assert [item["scene"] for item in report["missing"]] == ["0757"]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", 320), ("cameras", ["CAM_FRONT", "CAM_BACK"]), ("sweeps", True), ("poses", "refined"),
        ("holdout", {"every_nth": 8, "offset": 4, "last_block": 0}), ("regions", "masks"),
    ],
)  # fmt: skip
def test_a_result_of_another_protocol_is_left_out_and_named_with_the_difference(write, key, value):
    records = (metrics(scene, {"vanilla": VANILLA_A}) for scene in ("0061", "0553"))
    paths = [write(metrics("0103", {"vanilla": VANILLA_A}, **{key: value})), *map(write, records)]
    report = gap_report(sorted(paths), expecting("0061", "0103", "0553"), NO_LOGS)
    assert [row["scene"] for row in report["rows"]] == ["0061", "0553"]
    assert key in left_out(report, "0103") and "0061" in left_out(report, "0103")


@pytest.mark.parametrize("order", [1, -1])
def test_a_scene_that_kept_its_poses_is_comparable_with_refined_ones(write, order):
    """All were to be refined, and one was refused: that is the scene's nature, not another protocol."""
    made = {**stages(), "refine_poses": {"settings": {"rounds": 3}, "code": "r"}}
    results = {"0061": ("refined", made), "0103": ("nuscenes", made)}
    paths = [write(metrics(scene, {"vanilla": VANILLA_A}, stages, poses=poses))
             for scene, (poses, stages) in list(results.items())[::order]]  # fmt: skip
    report = gap_report(paths, report_job({"0061": made, "0103": made}), NO_LOGS)
    assert {row["scene"] for row in report["rows"]} == {"0061", "0103"} and report["left_out"] == []


def with_figure(value: Any) -> dict[str, Any]:
    record = copy.deepcopy(WHOLE)
    record["methods"]["vanilla"]["extrapolation"]["static"]["psnr"] = value
    return record


def shown_as(value: Any) -> dict[str, Any]:
    return {**WHOLE, "methods": {"vanilla": {**VANILLA_A, "shown": value}}}


WHOLE = metrics("0103", {"vanilla": VANILLA_A})
FOREIGN = "not the metrics of a scene"


@pytest.mark.parametrize(
    ("broken", "why"),
    [
        (with_figure(math.nan), "extrapolation_static of vanilla is nan, not a number"),
        (with_figure(-math.inf), "extrapolation_static of vanilla is -inf, not a number"),
        (with_figure("good"), "extrapolation_static of vanilla is 'good', not a number"),
        (with_figure([20.0]), "not a number"),
        ({**WHOLE, "methods": []}, "it has no method"),
        ({**WHOLE, "methods": {}}, "it has no method"),
        ({**WHOLE, "protocol": {**PROTOCOL, "extra_points": math.nan}}, FOREIGN),
        (shown_as("here"), FOREIGN),
        (shown_as({"group": 3}), "is of no group"),
        ([], ""),
        ({"scene": "0103"}, ""),
        ({**WHOLE, "provenance": {}}, ""),
        ({**WHOLE, "protocol": {}}, ""),
        ({key: value for key, value in WHOLE.items() if key != "methods"}, ""),
        (metrics("0103", {"vanilla": {}}), ""),
        (metrics("0103", {"vanilla": {**VANILLA_A, "tracks": "guessed"}}), "the tracks of vanilla are 'guessed'"),
    ],
    ids=range(16),
)
def test_a_foreign_or_damaged_result_is_left_out_and_named(write, broken, why):
    """With file and rule; the other scene stays, and the report can be written."""
    paths = [write(metrics("0061", {"vanilla": VANILLA_A})), write(json.dumps(broken), "0103")]
    report = gap_report(paths, expecting("0061", "0103"), NO_LOGS)
    assert [row["scene"] for row in report["rows"]] == ["0061"] and report["partial"]
    reason = left_out(report, "0103")
    assert why in reason and "0103/metrics.json" in reason and "'scene_metrics'" in reason, reason
    json.dumps(report, allow_nan=False)


@pytest.fixture
def report(write) -> dict[str, Any]:
    """Two measured scenes, one stale, one missing."""
    paths = [
        write(metrics("0061", {"vanilla": VANILLA_A})),
        write(metrics("0103", {"vanilla": VANILLA_B})),
        write(metrics("0553", {"vanilla": VANILLA_B}, stages(iterations=7000))),
    ]
    return gap_report(paths, expecting("0061", "0103", "0553", "0655"), NO_LOGS)


def test_the_csv_has_a_line_per_row_and_empty_cells_for_null(tmp_path, report):
    before = copy.deepcopy(report)
    write_figures(tmp_path / "gap_report.csv", report)
    with open(Path(tmp_path / "gap_report.csv"), newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "scene", "dataset", "method", "tracks",
        *(f"interpolation_{name}" for name in FIGURES), *(f"extrapolation_{name}" for name in FIGURES),
        "gaussians", "train_seconds",
    ]  # fmt: skip
    assert [row["scene"] for row in rows] == ["0061", "0103"]
    assert float(rows[0]["interpolation_gap_db"]) == 7.0 and float(rows[0]["interpolation_ssim"]) == 0.8
    assert (rows[0]["gaussians"], rows[0]["train_seconds"]) == ("1000", "60.0")
    assert rows[1]["extrapolation_vehicle"] == rows[0]["extrapolation_lpips"] == ""
    assert report == before


def test_the_console_table(report):
    lines = console_table(report).splitlines()
    headers = [i for i, line in enumerate(lines) if "scene" in line and "method" in line]
    by_region, whole = (lines[header : header + 4] for header in headers)
    for table in (by_region, whole):
        assert len({len(line) for line in table}) == 1, "columns line up"
        assert max(map(len, table)) <= 120
        assert "interp." in table[0] and "extrap." in table[0]
        assert "None" not in "\n".join(table) and "nan" not in "\n".join(table)
    first, second, mean = (line.split() for line in by_region[1:])
    assert first == ["0061", "vanilla", "17.00", "24.00", "19.00", "7.00", "14.00", "22.00", "14.00", "8.00"]
    assert second == ["0103", "vanilla", "-", "26.00", "22.00", "4.00", "-", "23.00", "-", "-"]
    assert mean[:4] == ["mean", "vanilla", "17.00", "25.00"]
    first, second, mean = (line.split() for line in whole[1:])
    assert first == ["0061", "vanilla", "23.00", "0.800", "0.300", "21.00", "0.800", "-", "1,000", "60"]
    assert second == ["0103", "vanilla", "25.00", "0.800", "0.100", "22.00", "0.800", "-", "3,000", "80"]
    assert mean == ["mean", "vanilla", "24.00", "0.800", "0.200", "21.50", "0.800", "-", "2,000", "70"]
    notes = "\n".join(lines[headers[1] + 4 :])
    assert "0553" in notes and "train.iterations" in notes and "0655" in notes


# ---- what it comes to


def test_a_mean_has_a_bootstrap_interval_over_scenes(tmp_path):
    """For scenes as different as these the interval is near the normal one: 1.96 standard errors to either side."""
    gaps = [5.0 + 0.5 * i for i in range(10)]
    report = compared(tmp_path, {f"{i:04}": ((25.0, 25.0 - gap), (25.0, 24.0)) for i, gap in enumerate(gaps)})
    vanilla, street = (mean["figures"]["interpolation_gap_db"] for mean in report["means"])
    error = np.std(gaps) / np.sqrt(10)
    assert vanilla["mean"] == pytest.approx(7.25) and vanilla["scenes"] == 10
    assert vanilla["low"] == pytest.approx(7.25 - 1.96 * error, abs=0.1)
    assert vanilla["high"] == pytest.approx(7.25 + 1.96 * error, abs=0.1)
    assert street["low"] == street["mean"] == street["high"] == pytest.approx(1.0)


def compared(folder: Path, scenes: dict[str, tuple[tuple[float, float | None] | None, ...]]) -> dict[str, Any]:
    """The report of scenes with PSNRs (static, moving) of vanilla and street between training frames."""
    records = []
    for scene, both in scenes.items():
        measured = {
            name: method(group(own[0], own[1], own[0] - 3.0 if own[1] is None else None), group(20.0))
            for name, own in zip(METHODS, both, strict=True)
            if own is not None
        }
        records.append(metrics(scene, measured, stages(METHODS)))
    return report_of(folder, *records, methods=METHODS)


def test_the_share_of_the_gap_closed_is_over_scenes_with_moving_vehicles(tmp_path):
    """(moving of street - moving of vanilla) / (static of vanilla - moving of vanilla), summed over scenes."""
    moving = {"0061": ((25.0, 17.0), (26.0, 23.0)), "0103": ((25.0, 21.0), (24.5, 22.0))}
    report = compared(tmp_path, {**moving, "0553": ((25.0, None), (29.0, None)), "0655": ((25.0, 16.0), None)})
    (street,) = report["gap_closed"]
    assert street["method"] == "street" and street["extrapolation"] is None
    closed = street["interpolation"]
    assert closed["fraction"] == pytest.approx((6.0 + 1.0) / (8.0 + 4.0)) and closed["scenes"] == 2
    assert closed["low"] == pytest.approx(1.0 / 4.0) and closed["high"] == pytest.approx(6.0 / 8.0)
    assert closed["moving_change"]["mean"] == pytest.approx(3.5)
    assert closed["static_change"] == pytest.approx({"mean": 0.25, "low": -0.5, "high": 1.0, "scenes": 2})
    (line,) = [line for line in summary_sentences(report) if line.startswith("street, between")]
    assert line == (
        "street, between training frames: moving vehicles 22.5 (22.0 to 23.0) dB, a gap of 2.8 (2.5 to 3.0) dB to "
        "static pixels, 2 scenes; against vanilla: moving vehicles +3.5 (+1.0 to +6.0) dB, 58 (25 to 75) % of its gap "
        "closed; static pixels +0.2 (-0.5 to +1.0) dB"
    )


@pytest.mark.parametrize(
    ("street", "fraction", "words"),
    [
        ((22.0, 17.0), 0.0, "moving vehicles +0.0 dB, 0 % of its gap closed; static pixels -3.0 dB"),
        ((22.0, 26.6), 1.2, "moving vehicles +9.6 dB, 120 % of its gap closed; static pixels -3.0 dB"),
        ((26.0, 15.0), -0.25, "moving vehicles -2.0 dB, -25 % of its gap closed; static pixels +1.0 dB"),
    ],
)
def test_lost_static_pixels_close_no_gap_and_are_stated(tmp_path, street, fraction, words):
    report = compared(tmp_path, {"0061": ((25.0, 17.0), street)})
    closed = report["gap_closed"][0]["interpolation"]
    assert closed["fraction"] == pytest.approx(fraction) and closed["low"] is None, "one scene has no interval"
    assert summary_sentences(report)[-1].endswith(words)


# ---- why a scene is missing
BEGINS, ENDS = (f"INFO drivesplat.workflow.job: extract 0103 {word}" for word in ("begins", "ends"))


BROKEN = "ERROR drivesplat.workflow.job: extract 0103: image n015.jpg is broken"
NO_MEMORY = "ERROR drivesplat.workflow.job: vanilla/train 0103: no memory"


@pytest.mark.parametrize(
    ("logs", "why"),
    [
        ({}, "not measured"),
        ({"extract": (BEGINS, ENDS)}, "not measured"),
        ({"extract": (BEGINS, BROKEN)}, "extract: image n015.jpg is broken"),
        ({"extract": (BEGINS, ENDS), "vanilla/train": (BEGINS,)}, "vanilla/train was interrupted"),
        ({"extract": (BEGINS, ENDS), "vanilla/train": (BEGINS, NO_MEMORY)}, "vanilla/train: no memory"),
    ],
)
def test_a_missing_scene_has_the_reason_from_its_logs_and_a_report_without_results_is_written(tmp_path, logs, why):
    for name, lines in logs.items():
        path = tmp_path / "logs/0103" / f"{name}.log"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"2026-11-21 23:32:06,793 {line}\n" for line in lines))
    report = gap_report([], expecting("0103"), tmp_path / "logs")
    (missing,) = report["missing"]
    assert missing["scene"] == "0103" and missing["why"].startswith(why)
    assert report["partial"] is True and report["rows"] == report["means"] == []
    write_figures(tmp_path / "gap_report.csv", report)
    assert len((tmp_path / "gap_report.csv").read_text().splitlines()) == 1
    assert "0103" in console_table(report)


def test_a_scene_without_cameras_stands_beside_scenes_with_one(write):
    """Its figures of images are null, and its protocol is compared with that of scenes without cameras alone."""
    nothing = dict.fromkeys(group(24.0))
    alone = {"cameras": [], "eval_camera": None, "width": None, "height": None}
    lidar = {"with_lidar": method(nothing, nothing)}
    records = [metrics("0061", {"vanilla": VANILLA_A}), metrics("a1", lidar, **alone), metrics("a2", lidar, **alone)]
    other = metrics("a3", lidar, **alone, holdout={"every_nth": 5, "offset": 4, "last_block": 0})
    made = {
        name: stages(methods)
        for name, methods in (("0061", ("vanilla",)), *((f"a{i}", ("with_lidar",)) for i in (1, 2, 3)))
    }
    job = report_job(made)
    report = gap_report([write(record) for record in (*records, other)], job, NO_LOGS)
    assert [row["scene"] for row in report["rows"]] == ["0061", "a1", "a2"]
    assert all(value is None for name, value in report["rows"][1].items() if name.startswith(("inter", "extra")))
    assert report["left_out"] == [{"scene": "a3", "why": "its protocol differs from that of scene a1: holdout"}]
    assert {mean["method"]: mean["figures"]["interpolation_static"] and 1 for mean in report["means"]} == {
        "vanilla": 1, "with_lidar": None
    }  # fmt: skip
    assert "with_lidar" in console_table(report)


def test_rows_say_which_tracks_a_method_trained_with_and_older_ones_had_annotated_ones(tmp_path):
    others = {"found": "discovered", "blind": "none"}
    methods = {"vanilla": VANILLA_A, **{name: {**VANILLA_A, "tracks": tracks} for name, tracks in others.items()}}
    report = report_of(tmp_path, metrics("0061", methods), methods=tuple(methods))
    write_figures(tmp_path / "gap_report.csv", report)
    with open(tmp_path / "gap_report.csv", newline="", encoding="utf-8") as file:
        for rows in (report["rows"], report["means"], csv.DictReader(file)):
            assert [row["tracks"] for row in rows] == ["annotated", "discovered", "none"]
