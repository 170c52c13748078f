"""LiDAR in the report: rows, means, and the tables of the page, the CSV and the console."""

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


def test_rows_are_of_methods_that_render_lidar_and_of_the_baselines(report):
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


def test_means_are_over_scenes_with_the_figure_and_rays_are_summed(report):
    means = {mean["method"]: mean["figures"] for mean in report["lidar"]["means"]}
    assert list(means) == ["street_lidar", "nearest_scan", "neighbouring_scans"]
    own = means["street_lidar"]
    whole, moving = (own[f"interpolation_lidar_{name}_range_error_median_m"] for name in ("all", "moving_vehicle"))
    assert whole == {"mean": pytest.approx(0.06), "low": 0.04, "high": 0.08, "scenes": 2}
    assert (moving["mean"], moving["scenes"]) == (0.04, 1)
    assert own["interpolation_lidar_all_rays"] == 2 * 34720
    assert own["interpolation_lidar_moving_vehicle_rays"] == 34720 + 3


def page_rows(page: str) -> list[list[str]]:
    (table,) = re.findall(r'<table class="sortable scans">(.*?)</table>', page, re.S)
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
