"""Published figures beside measured ones: in the record, the CSV, on the console and on the page."""

import csv
import json
import re
from typing import Any

import pytest
from helpers.reports import NO_LOGS, expecting, group, method, metrics, region, stages

from drivesplat.io.storage import write_json
from drivesplat.report.gaps import COLUMNS, gap_report
from drivesplat.report.html import report_page
from drivesplat.report.tables import write_figures
from drivesplat.settings.published import PublishedFigures

METHODS = ("vanilla", "street")
PAPER = {"source": "A & B 2026", "url": "https://example.org/a?b=c&d"}
BLOG = {"source": "A blog", "url": "https://example.org/blog"}
FIGURES = [
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


def report_of(tmp_path, published: list[dict[str, Any]] = FIGURES) -> dict[str, Any]:
    paths = []
    for scene, psnr in (("0061", 25.0), ("0103", 27.0)):
        measured = {"vanilla": of_scene(psnr, psnr + 1.0), "street": of_scene(psnr + 2.0, psnr + 3.0)}
        write_json(tmp_path / scene / "metrics.json", metrics(scene, measured, stages(METHODS)))
        paths.append(str(tmp_path / scene / "metrics.json"))
    entries = tuple(PublishedFigures.model_validate(entry) for entry in published)
    job = expecting("0061", "0103", methods=METHODS).model_copy(update={"published": entries})
    return gap_report(paths, job, NO_LOGS)


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> dict[str, Any]:
    return report_of(tmp_path_factory.mktemp("published"))


def selected(report: dict[str, Any], **values: Any) -> list[dict[str, Any]]:
    return [row for row in report["published"] if all(row[key] == value for key, value in values.items())]


def test_measured_figures_follow_the_published_ones_of_their_scene_region_group_and_publication(report):
    rows = selected(report, source="A & B 2026", scene="0061", region="all", group="interpolation")
    keys = ("method", "measured", "psnr", "ssim", "lpips", "train_minutes", "gpu")
    assert [tuple(row[key] for key in keys) for row in rows] == [
        ("SG", False, 22.87, 0.65, 0.13, None, None),
        ("<PVG>", False, 22.77, None, None, 31.5, "RTX 3090"),
        ("vanilla", True, 26.0, 0.8, 0.3, 1.5, "cpu"),
        ("street", True, 28.0, 0.8, 0.3, 1.5, "cpu"),
    ]
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert [row["psnr"] for row in selected(report, region="moving_vehicle")] == [23.2, 17.0, 17.0]
    beyond = selected(report, group="extrapolation")
    assert [(row["psnr"], row["ssim"]) for row in beyond] == [(None, 0.5), (21.0, 0.8), (21.0, 0.8)]
    assert [row["psnr"] for row in selected(report, source="A blog", scene="0061")] == [32.0, 26.0, 28.0]
    assert [row["source"] for row in report["published"]] == sorted(row["source"] for row in report["published"])


def test_a_scene_whose_compared_figures_are_no_numbers_is_left_out_and_named(tmp_path):
    broken = {"vanilla": of_scene(25.0, 26.0)}
    broken["vanilla"]["interpolation"]["moving_vehicle"]["ssim"] = "good"
    write_json(tmp_path / "0061/metrics.json", metrics("0061", broken))
    entry = PublishedFigures(**PAPER, scene="0061", region="moving_vehicle", method="SG", psnr=20.0)
    job = expecting("0061").model_copy(update={"published": (entry,)})
    report = gap_report([str(tmp_path / "0061/metrics.json")], job, NO_LOGS)
    (left_out,) = report["left_out"]
    assert "ssim of moving_vehicle is 'good', not a number" in left_out["why"] and report["rows"] == []
    assert len(report["published"]) == 1


def test_the_csv_has_published_figures_in_the_same_columns(tmp_path, report):
    def table(made: dict[str, Any]) -> list[dict[str, str]]:
        write_figures(tmp_path / "figures.csv", made)
        with open(tmp_path / "figures.csv", newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    without, rows = table(report_of(tmp_path, [])), table(report)
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


def test_the_page_has_a_table_per_publication_with_its_link(report):
    page = report_page(report, {})
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
    page = report_page(report_of(tmp_path, [{**FIGURES[0], **changes}]), {})
    unscripted = re.sub(r"</script>\s*(?=<script>|</body>)", "", page)
    assert not any(value in unscripted for value in changes.values())
