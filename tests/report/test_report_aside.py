"""Views from beside the recorded path in the report: rows, means, and tables of the page, the CSV and the console."""

import json
import re
from typing import Any

import pytest
from helpers.reports import group, method, metrics, report_of

from drivesplat.report.files import console_table
from drivesplat.report.html import report_page

METHODS = ("vanilla", "street")


def view(static: float, depth: float | None = None) -> dict[str, Any]:
    """The figures of a view without moving vehicles."""
    error = {} if depth is None else {"depth": {"median_relative_error": depth}}
    return {"static": {"psnr": static}, "moving_vehicle": None, **error}


def record(scene: str, better: float) -> dict[str, Any]:
    """A metrics.json with two views beside the path and a left-out camera; PSNRs of `street` are `better` dB higher."""
    by_method = {
        name: {
            **method(group(24.0, 17.0), group(22.0, 14.0)),
            "lateral": {"4.0": view(20.0 + more, 0.4), "2.0": view(22.0 + more, 0.2)},
            "side_camera": {"CAM_BACK": view(18.0 + more)},
        }
        for name, more in zip(METHODS, (0.0, better), strict=True)
    }
    return metrics(scene, by_method)


@pytest.fixture
def report(tmp_path) -> dict[str, Any]:
    return report_of(tmp_path, record("0061", 1.0), record("0103", 3.0), methods=METHODS)


def test_rows_are_by_scene_view_and_method_and_means_over_scenes(report):
    rows = report["aside"]["rows"]
    assert [(row["view"], row["method"], row["static"], row["depth_error"]) for row in rows[:6]] == [
        ("2.0", "vanilla", 22.0, 0.2), ("2.0", "street", 23.0, 0.2),
        ("4.0", "vanilla", 20.0, 0.4), ("4.0", "street", 21.0, 0.4),
        ("CAM_BACK", "vanilla", 18.0, None), ("CAM_BACK", "street", 19.0, None),
    ]  # fmt: skip
    means = {(mean["view"], mean["method"]): mean["figures"] for mean in report["aside"]["means"]}
    assert means["2.0", "street"]["static"] == {"mean": 24.0, "low": 23.0, "high": 25.0, "scenes": 2}
    assert means["CAM_BACK", "street"]["depth_error"] is None and means["2.0", "street"]["moving_vehicle"] is None
    json.dumps(report, allow_nan=False)


def page_rows(page: str) -> list[list[str]]:
    (table,) = re.findall(r'<table class="sortable aside">(.*?)</table>', page, re.S)
    return [re.findall(r"<td[^>]*>([^<]*)", row) for row in re.findall(r"<tr>\s*(<td.*?)</tr>", table, re.S)]


def test_the_page_has_a_row_for_each_view_and_means_of_several_scenes(report):
    rows = page_rows(report_page(report, {}))
    assert len(rows) == 12 + 6
    assert rows[1] == ["0061", "2 m to the left", "street", "23.0", "–", "20.0%"]
    assert rows[5] == ["0061", "CAM_BACK, left out", "street", "19.0", "–", "–"]
    assert rows[13][:4] == ["mean", "2 m to the left", "street", "24.0"]


def test_one_scene_has_no_means_and_a_drive_without_such_views_no_table(tmp_path):
    one = report_of(tmp_path / "one", record("0061", 1.0), methods=METHODS)
    assert len(page_rows(report_page(one, {}))) == 6
    bare = metrics("0061", {name: method(group(24.0, 17.0), group(22.0, 14.0)) for name in METHODS})
    none = report_of(tmp_path / "none", bare, methods=METHODS)
    assert none["aside"] == {"rows": [], "means": []}
    assert 'id="aside"' not in report_page(none, {}) and "beside the recorded path" not in console_table(none)


def test_a_figure_that_is_no_number_leaves_the_scene_out(tmp_path):
    broken = record("0061", 1.0)
    broken["methods"]["street"]["lateral"]["2.0"]["static"]["psnr"] = "high"
    found = report_of(tmp_path, broken, record("0103", 1.0), methods=METHODS)
    assert [item["scene"] for item in found["left_out"]] == ["0061"]
    assert "'high', not a number" in found["left_out"][0]["why"]
