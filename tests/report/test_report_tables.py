"""LiDAR, views from beside the recorded path and published figures in the report: rows, means and tables."""

import copy
import csv
import json
import math
import re
from typing import Any

import pytest
from helpers.reports import NO_LOGS, expecting, group, method, metrics, region, report_of, stages

from drivesplat.evaluation.scan_metrics import FIGURES, SCAN_REGIONS
from drivesplat.io.storage import write_json
from drivesplat.report.files import console_table, report_page
from drivesplat.report.gaps import COLUMNS, gap_report
from drivesplat.report.tables import write_figures
from drivesplat.settings.published import PublishedFigures

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
            view(psnr + more, road={"psnr": 21.5}, markings=None, depth={"median_relative_error": off})
            for psnr, off in ((20.0, 0.4), (22.0, 0.2))
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
    assert rows[1] == ["0061", "2 m to the left", "street", "23.0", "–", "21.5", "–", "20.0%"]
    assert rows[5] == ["0061", "CAM_BACK, left out", "street", "19.0", *"––––"]
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


PAPER = {"source": "A & B 2026", "url": "https://example.org/a?b=c&d"}
BLOG = {"source": "A blog", "url": "https://example.org/blog"}
PUBLISHED = [
    {**PAPER, "scene": "0061", "method": "SG", "psnr": 22.87, "ssim": 0.65, "lpips": 0.13},
    {**PAPER, "scene": "0061", "method": "<PVG>", "psnr": 22.77, "train_minutes": 31.5, "gpu": "RTX 3090"},
    {**PAPER, "scene": "mean", "scenes": 2, "method": "SG", "psnr": 22.5},
    {**PAPER, "scene": "mean", "scenes": 6, "method": "SG", "psnr": 22.9},
    {**BLOG, "scene": "0061", "method": "SG", "psnr": 32.0},
    {**BLOG, "scene": "0553", "method": "SG", "psnr": 31.0},
    {**PAPER, "scene": "0061", "region": "moving_vehicle", "method": "SG", "psnr": 23.2},
    {**PAPER, "scene": "0061", "group": "extrapolation", "method": "SG", "ssim": 0.5},
]


def of_scene(psnr: float, frame_mean: float) -> dict[str, Any]:
    """A scene whose pooled PSNR differs from the mean over images."""
    between = {**group(24.0, 17.0), "all": {**region(psnr, 0.3), "psnr_frame_mean": frame_mean}}
    return method(between, group(22.0), seconds=90.0)


def published_report(tmp_path, published: list[dict[str, Any]] = PUBLISHED) -> dict[str, Any]:
    paths = []
    for scene, psnr in (("0061", 25.0), ("0103", 27.0)):
        measured = {"vanilla": of_scene(psnr, psnr + 1.0), "street": of_scene(psnr + 2.0, psnr + 3.0)}
        write_json(tmp_path / scene / "metrics.json", metrics(scene, measured, stages(BOTH)))
        paths.append(str(tmp_path / scene / "metrics.json"))
    entries = tuple(PublishedFigures.model_validate(entry) for entry in published)
    job = expecting("0061", "0103", methods=BOTH).model_copy(update={"published": entries})
    return gap_report(paths, job, NO_LOGS)


@pytest.fixture(scope="module")
def published(tmp_path_factory) -> dict[str, Any]:
    return published_report(tmp_path_factory.mktemp("published"))


def selected(published: dict[str, Any], **values: Any) -> list[dict[str, Any]]:
    return [row for row in published["published"] if all(row[key] == value for key, value in values.items())]


def test_measured_figures_follow_the_published_ones_of_their_scene_region_group_and_publication(published):
    rows = selected(published, source="A & B 2026", scene="0061", region="all", group="interpolation")
    keys = ("method", "measured", "psnr", "ssim", "lpips", "train_minutes", "gpu")
    assert [tuple(row[key] for key in keys) for row in rows] == [
        ("SG", False, 22.87, 0.65, 0.13, None, None),
        ("<PVG>", False, 22.77, None, None, 31.5, "RTX 3090"),
        ("vanilla", True, 26.0, 0.8, 0.3, 1.5, "cpu"),
        ("street", True, 28.0, 0.8, 0.3, 1.5, "cpu"),
    ]
    assert json.loads(json.dumps(published, allow_nan=False)) == published
    assert [row["psnr"] for row in selected(published, region="moving_vehicle")] == [23.2, 17.0, 17.0]
    beyond = selected(published, group="extrapolation")
    assert [(row["psnr"], row["ssim"]) for row in beyond] == [(None, 0.5), (21.0, 0.8), (21.0, 0.8)]
    assert [row["psnr"] for row in selected(published, source="A blog", scene="0061")] == [32.0, 26.0, 28.0]
    assert [row["source"] for row in published["published"]] == sorted(row["source"] for row in published["published"])


def test_a_scene_whose_compared_figures_are_no_numbers_is_left_out_and_named(tmp_path):
    broken = {"vanilla": of_scene(25.0, 26.0)}
    broken["vanilla"]["interpolation"]["moving_vehicle"]["ssim"] = "good"
    write_json(tmp_path / "0061/metrics.json", metrics("0061", broken))
    entry = PublishedFigures(**PAPER, scene="0061", region="moving_vehicle", method="SG", psnr=20.0)
    job = expecting("0061").model_copy(update={"published": (entry,)})
    published = gap_report([str(tmp_path / "0061/metrics.json")], job, NO_LOGS)
    (left_out,) = published["left_out"]
    assert "ssim of moving_vehicle is 'good', not a number" in left_out["why"] and published["rows"] == []
    assert len(published["published"]) == 1


def test_the_csv_has_published_figures_in_the_same_columns(tmp_path, published):
    def table(made: dict[str, Any]) -> list[dict[str, str]]:
        write_figures(tmp_path / "figures.csv", made)
        with open(tmp_path / "figures.csv", newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    without, rows = table(published_report(tmp_path, [])), table(published)
    assert list(without[0]) == list(COLUMNS) and len(without) == 4
    assert list(rows[0]) == [*COLUMNS, "source", "url"]
    figures = [(row["scene"], row["method"], row["source"], row["interpolation_psnr_frame_mean"]) for row in rows]
    assert figures[:5] == [
        ("0061", "vanilla", "", "26.0"), ("0061", "street", "", "28.0"), ("0103", "vanilla", "", "28.0"),
        ("0103", "street", "", "30.0"), ("0061", "SG", "A & B 2026", "22.87"),
    ]  # fmt: skip
    assert ("mean", "SG", "A & B 2026", "22.5") in figures and ("mean", "street", "", "29.0") in figures
    (timed,) = [row for row in rows if row["method"] == "<PVG>"]
    assert (timed["train_seconds"], timed["interpolation_psnr"], timed["url"]) == ("1890.0", "", PAPER["url"])
    assert not any(row["interpolation_psnr_frame_mean"] == "23.2" for row in rows), "not of whole images"


def test_the_page_has_a_table_per_publication_with_its_link(published):
    page = report_page(published, {})
    assert page.count('<table class="published">') == 2
    assert '<h3><a href="https://example.org/a?b=c&amp;d">A &amp; B 2026</a></h3>' in page
    table = page.partition('<table class="published">')[2].partition("</table>")[0]
    rows = [re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in table.split("<tr")[2:]]
    assert rows[:3] == [
        ["0061", "whole images", "SG", "published", "22.87", "0.650", "0.130", "–", "–"],
        ["0061", "whole images", "&lt;PVG&gt;", "published", "22.77", "–", "–", "31.5", "RTX 3090"],
        ["0061", "whole images", "vanilla", "measured here", "26.00", "0.800", "0.300", "1.5", "cpu"],
    ]
    assert ["mean of 6", "whole images", "SG", "published", "22.90", *"–––––"][:8] in [row[:8] for row in rows]
    assert ["mean of 2", "whole images", "street", "measured here", "–", "–", "–", "–", "cpu"] in rows
    assert [row[1] for row in rows if row[2] == "SG"][-2:] == ["moving vehicle", "whole images, extrapolation"]
    assert "mean over held-out images of the PSNR of each image" in page


def test_texts_of_users_are_escaped(tmp_path):
    changes = {"method": "</script>", "source": "<img src=x>", "gpu": "<u>"}
    page = report_page(published_report(tmp_path, [{**PUBLISHED[0], **changes}]), {})
    unscripted = re.sub(r"</script>\s*(?=<script>|</body>)", "", page)
    assert not any(value in unscripted for value in changes.values())
