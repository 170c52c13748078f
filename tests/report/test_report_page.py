"""gap_report.html: what stands in it, and that it needs a browser and nothing else."""

import base64
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.chromium import chromium, in_a_browser
from helpers.reports import expecting, group, method, metrics, stages
from PIL import Image

from drivesplat.io.storage import write_json
from drivesplat.report.files import gap_plot, report_page
from drivesplat.report.gaps import gap_report
from drivesplat.report.media import MAX_WIDTH, collect_media, data_url, read_image
from drivesplat.settings.report import PICTURES

METHODS = ("vanilla", "street")
GAPS = {"0061": (7.5, 1.0), "0103": (4.0, 1.5), "0553": (10.5, 2.0), "0655": (None, None)}
"""Of vanilla and street between training frames; where it is None there is no vehicle."""


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """A results folder of four scenes; a fifth is configured, and failed."""
    folder = tmp_path_factory.mktemp("results")
    for scene, gaps in GAPS.items():
        measured = {}
        for name, gap in zip(METHODS, gaps, strict=True):
            measured[name] = method(group(25.0, None if gap is None else 25.0 - gap), group(20.0))
            measured[name]["shown"] = {"group": "interpolation", "key_frame": 12}
            for number, picture in enumerate(PICTURES.values()):
                paint(folder / scene / name / picture, 40 * number)
            (folder / scene / name / "original.mp4").touch()
        write_json(folder / scene / "metrics.json", metrics(scene, measured, stages(METHODS)))
    log = folder / "logs/1100/street/train.log"
    log.parent.mkdir(parents=True)
    error = "ERROR drivesplat.workflow.job: street/train 1100: <b>no memory</b> & more"
    log.write_text(f"2026-11-21 23:32:06,793 {error}\n")
    return folder


def paint(path: Path, shade: int, size: tuple[int, int] = (160, 90)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (shade, 200, 255 - shade)).save(path)


def made(results: Path) -> dict[str, Any]:
    paths = [str(results / scene / "metrics.json") for scene in GAPS]
    return gap_report(paths, expecting(*GAPS, "1100", methods=METHODS), results / "logs")


def page_of(results: Path) -> str:
    files = [file for scene in GAPS for file in sorted((results / scene).rglob("*.*")) if file.parent.name in METHODS]
    return report_page(made(results), collect_media(files, results))


@pytest.fixture(scope="module")
def page(results) -> str:
    return page_of(results)


def test_a_page_requests_nothing_and_is_deterministic(results, page):
    assert page == page_of(results)
    assert "default-src 'none'" in page and "<script src" not in page and '<link rel="stylesheet' not in page
    addresses = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(addresses) > 20
    assert {address.partition(":")[0] for address in addresses if ":" in address} == {"data"}
    assert set(re.findall(r"https?://[^\s\"<]*", page)) <= NAMESPACES, "namespaces are not requested"


NAMESPACES = {
    "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink", "http://purl.org/dc/elements/1.1/",
    "http://creativecommons.org/ns#", "http://www.w3.org/1999/02/22-rdf-syntax-ns#", "http://purl.org/dc/dcmitype/StillImage",
}  # fmt: skip


def test_a_page_lists_missing_scenes_with_reasons(results, page):
    assert "Partial: 4 of 5 configured scenes" in page
    assert "<b>1100</b>: street/train: &lt;b&gt;no memory&lt;/b&gt; &amp; more" in page
    whole = {**made(results), "partial": False, "missing": []}
    assert "Partial" not in report_page(whole, {}) and "Not in the table" not in report_page(whole, {})


def test_a_page_has_the_images_and_links_of_its_methods(results, page):
    assert page.count("data:image/jpeg") == len(GAPS) * len(METHODS) * len(PICTURES)
    assert 'href="0061/vanilla/original.mp4"' in page and "key frame 12, held out between training frames" in page
    film = report_page(made(results), collect_media([results / "0061/compare.mp4"], results))
    assert 'href="0061/compare.mp4">compare.mp4<' in film and film.count(".mp4") == 2
    films = report_page(made(results), collect_media([results / "0061/index.html"], results))
    assert 'href="0061/index.html">all films<' in films
    bare = report_page(made(results), {})
    assert "data:image/jpeg" not in bare and ".mp4" not in bare and 'id="scene-0061"' in bare


def test_a_page_has_the_metrics_of_whole_images_and_a_glossary(page):
    """PSNR, SSIM, LPIPS, Gaussians and training time of every scene and method, and which way each is better."""
    tables = re.findall(r"<h3>([^<]*)</h3>\s*<div class=\"card wide\">(<table.*?</table>)", page, re.S)
    titles = [title for title, _ in tables]
    assert titles == ["Moving vehicles and static pixels: PSNR in dB", "Whole images, with the cost of training"]
    heads = [re.findall(r"<button[^>]*>([^<]*)</button>", table) for _, table in tables]
    assert heads[0] == ["scene", "method", *["moving", "static", "vehicle", "gap"] * 2]
    whole = ["PSNR ↑", "SSIM ↑", "LPIPS ↓"]
    assert heads[1] == ["scene", "method", *whole * 2, "Gaussians", "training, s"]
    rows = re.findall(r"<tr>(<td.*?)</tr>", tables[1][1])
    assert len(rows) == len(GAPS) * len(METHODS) + len(METHODS)
    assert re.findall(r">([^<]*)</td>", rows[1]) == [
        "0061", "street", "24.0", "0.800", "–", "19.0", "0.800", "–", "1,000", "60"
    ]  # fmt: skip
    explained = re.findall(r"<dt>([^<]*)</dt><dd>([^<]*)", page)
    names = {name.strip() for terms, _ in explained for name in terms.split(",")}
    assert {"PSNR", "SSIM", "LPIPS", "moving", "static", "gap", "Gaussians", "share of the gap closed"} <= names
    assert "Higher is better" in dict(explained)["PSNR"] and "Lower is better" in dict(explained)["LPIPS"]


def test_large_images_are_reduced(tmp_path):
    for size, expected in (((2000, 500), (MAX_WIDTH, MAX_WIDTH // 4)), ((160, 90), (160, 90))):
        paint(tmp_path / "a.png", 100, size)
        address = data_url(read_image(tmp_path / "a.png"))
        picture = Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2])))
        assert picture.size == expected
        np.testing.assert_allclose(np.asarray(picture)[5, 5], [100, 200, 155], atol=4)


def test_media_are_collected_by_scene_and_method(tmp_path):
    names = (
        "0061/street/edits/remove.mp4", "0061/street/ghost_panel.png", "0103/vanilla/viewer.html", "0103/compare.mp4"
    )  # fmt: skip
    media = collect_media([tmp_path / name for name in names], tmp_path)
    assert set(media) == {("0061", "street"), ("0103", "vanilla"), ("0103", "")}
    assert media["0103", ""].links == ["0103/compare.mp4"]
    assert media["0061", "street"].images == {"panel": tmp_path / "0061/street/ghost_panel.png"}
    assert media["0061", "street"].links == ["0061/street/edits/remove.mp4"]
    assert media["0103", "vanilla"].links == ["0103/vanilla/viewer.html"]


def test_the_plot_has_a_dot_for_every_scene_with_moving_vehicles(results):
    drawing = gap_plot(made(results))
    assert drawing.startswith("<svg") and "between training frames" in drawing
    assert "beyond the last training frame" not in drawing, "no vehicle moves there"
    assert all(f">{name}<" in drawing for name in METHODS)
    dots = [re.findall(rf"<use [^>]*fill: {color}", drawing) for color in ("#0072b2", "#d55e00")]
    assert [len(of_method) for of_method in dots] == [3, 3]


@in_a_browser
def test_in_a_browser_sorting_and_sliders_work_without_requests(page, tmp_path):
    file = tmp_path / "gap_report.html"
    file.write_text(page, encoding="utf-8")
    cells = "[...document.querySelector('table.sortable').tBodies[0].rows].map((row) => row.cells[5].dataset.value)"
    head = "document.querySelectorAll('th[data-column]')[5]"
    with chromium(tmp_path / "profile") as tab:
        tab.open(file, 1300, 900)
        gaps = [gap for pair in GAPS.values() for gap in pair]
        assert [float(value) if value else None for value in tab.run(cells)] == gaps
        for order, reverse in (("ascending", False), ("descending", True)):
            tab.run(f"{head}.querySelector('button').click()")
            there = sorted((gap for gap in gaps if gap is not None), reverse=reverse)
            found = [float(value) if value else None for value in tab.run(cells)]
            assert found == [*there, None, None], "empty cells come last"
            assert tab.run(f"{head}.getAttribute('aria-sort')") == order
        slide = "s = document.querySelector('.compare input'), s.value = 20, s.dispatchEvent(new Event('input'))"
        over = "getComputedStyle(document.querySelector('.compare .over')).clipPath"
        before = tab.run(over)
        tab.run(slide)
        assert "50%" in before and "20%" in tab.run(over)
        assert tab.complaints == []
        assert [address for address in tab.requests if not address.startswith("data:")] == [file.as_uri()]
