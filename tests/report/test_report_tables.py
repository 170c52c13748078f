"""LiDAR and views from beside the recorded path in the report: rows, means, and tables of the page, the CSV and the
console."""

import copy
import json
import math
import re
from typing import Any

import pytest
from helpers.reports import group, method, metrics, report_of

from drivesplat.evaluation.scan_metrics import FIGURES, SCAN_REGIONS
from drivesplat.report.files import console_table
from drivesplat.report.html import report_page
from drivesplat.report.tables import write_figures

METHODS = ("vanilla", "street_lidar")
FEW = "fewer than 100 measured rays"


def scans(median: float, moving: bool = True) -> dict[str, Any]:
    """The figures of a held-out group by region."""
    own = {
        "range_error_median_m": median, "range_error_mean_m": 2 * median, "range_error_median_sq": median**2,
        "intensity_rmse": 0.08, "drop_accuracy": 0.95, "chamfer_m": 0.18, "rays": 34720, "returns": 20000,
    }  # fmt: skip
    nothing = {**dict.fromkeys(FIGURES), "rays": 3, "returns": 3, "unavailable": FEW}
    return {region: nothing if region == "moving_vehicle" and not moving else dict(own) for region in SCAN_REGIONS}


def record(scene: str, medians: tuple[float, float, float], moving: bool = True) -> dict[str, Any]:
    """A metrics.json with range errors (metres) of street_lidar and of both baselines; beyond training, twice them."""

    def groups(median: float) -> dict[str, Any]:
        return {"interpolation": scans(median, moving), "extrapolation": scans(2 * median)}

    figures = group(24.0, 17.0), group(22.0, 14.0)
    own, *others = map(groups, medians)
    with_scans = method(*({**images, "lidar": own[name]} for images, name in zip(figures, own, strict=True)))
    found = metrics(scene, {"vanilla": method(*figures), "street_lidar": with_scans})
    return {**found, "lidar_baselines": dict(zip(("nearest_scan", "neighbouring_scans"), others, strict=True))}


RECORDS = (record("0061", (0.04, 0.06, 0.05)), record("0103", (0.08, 0.07, 0.09), moving=False))


@pytest.fixture
def report(tmp_path) -> dict[str, Any]:
    return report_of(tmp_path, *RECORDS, methods=METHODS)


def test_rows_of_lidar_are_of_methods_that_render_it_and_of_baselines_and_means_over_scenes_with_the_figure(report):
    rows = report["lidar"]["rows"]
    assert [(row["scene"], row["method"], row["baseline"]) for row in rows] == [
        (scene, name, name != "street_lidar")
        for scene in ("0061", "0103") for name in ("street_lidar", "nearest_scan", "neighbouring_scans")
    ]  # fmt: skip
    assert rows[0]["interpolation_lidar_all_range_error_median_m"] == 0.04
    assert rows[1]["extrapolation_lidar_static_range_error_median_m"] == 0.12
    assert rows[3]["interpolation_lidar_moving_vehicle_chamfer_m"] is None
    assert rows[3]["reasons"] == {"interpolation": {"moving_vehicle": FEW}, "extrapolation": {}}
    json.dumps(report, allow_nan=False)
    means = {mean["method"]: mean["figures"] for mean in report["lidar"]["means"]}
    assert list(means) == ["street_lidar", "nearest_scan", "neighbouring_scans"]
    own = means["street_lidar"]
    whole, moving = (own[f"interpolation_lidar_{name}_range_error_median_m"] for name in ("all", "moving_vehicle"))
    assert whole == {"mean": pytest.approx(0.06), "low": 0.04, "high": 0.08, "scenes": 2}
    assert (moving["mean"], moving["scenes"]) == (0.04, 1)
    assert own["interpolation_lidar_all_rays"] == 2 * 34720
    assert own["interpolation_lidar_moving_vehicle_rays"] == 34720 + 3


def page_rows(page: str, kind: str = "scans") -> list[list[str]]:
    (table,) = re.findall(rf'<table class="sortable {kind}">(.*?)</table>', page, re.S)
    rows = re.findall(r"<tr[^>]*>\s*(<td.*?)</tr>", table, re.S)
    return [re.findall(r"<td[^>]*>([^<]*)", row) for row in rows]


def test_the_page_has_a_row_for_each_scene_region_and_method(report):
    page = report_page(report, {})
    rows = page_rows(page)
    assert len(rows) == 2 * 3 * 3 + 3 * 3
    figures = ["0.080", "95.0", "0.18", "34,720"]
    assert rows[0] == ["0061", "all rays", "street_lidar", "4.0", *figures, "8.0", *figures]
    assert rows[1][:4] == ["0061", "all rays", "nearest scan, moved", "6.0"]
    assert rows[15] == ["0103", "moving vehicles", "street_lidar", *"––––", "3", "16.0", *figures]
    assert rows[18][:4] == ["mean", "all rays", "street_lidar", "6.0"] and rows[18][7] == "69,440"
    assert "4.0 to 8.0" in page and page.count('<h2 id="lidar">LiDAR</h2>') == 1
    assert f"A dash: 0103, moving vehicles, between training frames: {FEW}." in page
    assert page.count(FEW) - page.count(f'"{FEW}"') == 1, "a reason of the recording is stated once"


def test_without_a_method_that_renders_lidar_nothing_is_said_of_it(tmp_path):
    without = metrics("0061", {name: method(group(24.0), group(22.0)) for name in METHODS})
    report = report_of(tmp_path, without, methods=METHODS)
    assert report["lidar"] == {"rows": [], "means": []}
    assert "LiDAR" not in console_table(report) and 'id="lidar"' not in report_page(report, {})
    write_figures(tmp_path / "gap_report.csv", report)
    assert "_lidar_" not in (tmp_path / "gap_report.csv").read_text()


@pytest.mark.parametrize(
    ("value", "why"),
    [(math.nan, "not JSON compliant"), ("near", "all chamfer_m of nearest_scan is 'near'")],
)
def test_a_scene_whose_figures_of_scans_are_no_numbers_is_left_out_and_named(tmp_path, value, why):
    broken = copy.deepcopy(RECORDS[1])
    broken["lidar_baselines"]["nearest_scan"]["interpolation"]["all"]["chamfer_m"] = value
    report = report_of(tmp_path, RECORDS[0], broken, methods=METHODS)
    assert {row["scene"] for row in report["rows"]} == {row["scene"] for row in report["lidar"]["rows"]} == {"0061"}
    (item,) = report["left_out"]
    assert item["scene"] == "0103" and why in item["why"]


BOTH = ("vanilla", "street")


def record_aside(scene: str, better: float) -> dict[str, Any]:
    """A metrics.json with two views beside the path and a left-out camera; PSNRs of `street` are `better` dB higher."""

    def view(static: float, **more: Any) -> dict[str, Any]:
        return {"static": {"psnr": static}, "moving_vehicle": None, **more}

    def of(more: float) -> dict[str, Any]:
        far, near = (
            view(psnr + more, depth={"median_relative_error": off}) for psnr, off in ((20.0, 0.4), (22.0, 0.2))
        )
        aside = {"lateral": {"4.0": far, "2.0": near}, "side_camera": {"CAM_BACK": view(18.0 + more)}}
        return {**method(group(24.0, 17.0), group(22.0, 14.0)), **aside}

    return metrics(scene, {"vanilla": of(0.0), "street": of(better)})


@pytest.fixture
def aside(tmp_path) -> dict[str, Any]:
    return report_of(tmp_path, record_aside("0061", 1.0), record_aside("0103", 3.0), methods=BOTH)


def test_rows_are_by_scene_view_and_method_and_means_over_scenes(aside):
    rows = aside["aside"]["rows"]
    assert [(row["view"], row["method"], row["static"], row["depth_error"]) for row in rows[:6]] == [
        ("2.0", "vanilla", 22.0, 0.2), ("2.0", "street", 23.0, 0.2),
        ("4.0", "vanilla", 20.0, 0.4), ("4.0", "street", 21.0, 0.4),
        ("CAM_BACK", "vanilla", 18.0, None), ("CAM_BACK", "street", 19.0, None),
    ]  # fmt: skip
    means = {(mean["view"], mean["method"]): mean["figures"] for mean in aside["aside"]["means"]}
    assert means["2.0", "street"]["static"] == {"mean": 24.0, "low": 23.0, "high": 25.0, "scenes": 2}
    assert means["CAM_BACK", "street"]["depth_error"] is None and means["2.0", "street"]["moving_vehicle"] is None
    json.dumps(aside, allow_nan=False)


def test_the_page_has_a_row_for_each_view_means_of_several_scenes_and_no_table_without_such_views(aside, tmp_path):
    rows = page_rows(report_page(aside, {}), "aside")
    assert len(rows) == 12 + 6
    assert rows[1] == ["0061", "2 m to the left", "street", "23.0", "–", "20.0%"]
    assert rows[5] == ["0061", "CAM_BACK, left out", "street", "19.0", "–", "–"]
    assert rows[13][:4] == ["mean", "2 m to the left", "street", "24.0"]
    one = report_of(tmp_path / "one", record_aside("0061", 1.0), methods=BOTH)
    assert len(page_rows(report_page(one, {}), "aside")) == 6
    bare = metrics("0061", {name: method(group(24.0, 17.0), group(22.0, 14.0)) for name in BOTH})
    none = report_of(tmp_path / "none", bare, methods=BOTH)
    assert none["aside"] == {"rows": [], "means": []}
    assert 'id="aside"' not in report_page(none, {}) and "beside the recorded path" not in console_table(none)


def test_a_figure_that_is_no_number_leaves_the_scene_out(tmp_path):
    broken = record_aside("0061", 1.0)
    broken["methods"]["street"]["lateral"]["2.0"]["static"]["psnr"] = "high"
    found = report_of(tmp_path, broken, record_aside("0103", 1.0), methods=BOTH)
    assert [item["scene"] for item in found["left_out"]] == ["0061"]
    assert "'high', not a number" in found["left_out"][0]["why"]
