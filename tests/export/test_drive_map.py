"""The page of a long drive: a map of its path, coloured by figures, that leads to the pages of its blocks."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from helpers.archives import NO_FILES, addresses
from helpers.chromium import chromium, in_a_browser
from helpers.long_paths import drive_along, straight
from helpers.patience import PATIENCE_S

from drivesplat.export import drive_page
from drivesplat.export.drive_map import GREY, drive_map_page
from drivesplat.preprocess.blocks import block_scene, cut_into_blocks
from drivesplat.scene.blocks import Blocks
from drivesplat.scene.scene import Scene
from drivesplat.settings.blocks import BlocksJob, CutSettings
from drivesplat.settings.images import HoldoutSettings

HOLDOUT = HoldoutSettings()
NODE = shutil.which("node")
PROVENANCE = {"settings_sha256": "a" * 64, "stages": {"train": {"note": "</script><b>"}}}


def cut(scene: Scene) -> Blocks:
    return cut_into_blocks(scene, BlocksJob(blocks=CutSettings(length_m=100.0, overlap_m=20.0), holdout=HOLDOUT))


def starts_of(scene: Scene, blocks: Blocks) -> dict[str, int]:
    scenes = [block_scene(scene, blocks, number, HOLDOUT) for number in range(len(blocks.blocks))]
    return {own.name: min(frame.timestamp for frame in own.frames) for own in scenes}


def measured(figures: dict[str, float | None], left_out: tuple[str, ...] = ()) -> dict:
    """The eval.json of a drive whose blocks have these PSNR of static pixels."""
    blocks = {
        name: {"interpolation": {"static": psnr, "moving_vehicle": None}, "gaussians": 1234 + number}
        for number, (name, psnr) in enumerate(figures.items())
    }
    result = {"interpolation": {"static": {"psnr": 27.125}}, "gaussians": 98765, "blocks": blocks}
    return {"result": result, "protocol": {"left_out": list(left_out)}}


def page_of(scene: Scene, blocks: Blocks, record: dict) -> str:
    starts = {name: time for name, time in starts_of(scene, blocks).items() if name in record["result"]["blocks"]}
    return drive_map_page(scene, blocks, starts, record, "street", PROVENANCE)


@pytest.fixture(scope="module")
def drive() -> tuple[Scene, Blocks]:
    """400 m straight ahead at 10 m/s, in four blocks."""
    scene = drive_along(straight(400))
    return scene, cut(scene)


FIGURES = {"long.000": 25.0, "long.001": 30.0, "long.003": None}


@pytest.fixture(scope="module")
def page(drive) -> str:
    """Block 2 is left out, and block 3 has no held-out static pixels."""
    return page_of(*drive, measured(FIGURES, ("long.002",)))


def lines_in(part: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """The lines in a part of the map: places (n, 2), y upwards, and their seconds (n,)."""
    found = re.findall(r'<polyline points="([^"]*)" data-seconds="([^"]*)"/>', part)
    places = [np.array([pair.split(",") for pair in points.split()], dtype=float) * [1, -1] for points, _ in found]
    return [(one, np.array(own.split(), dtype=float)) for one, (_, own) in zip(places, found, strict=True)]


def linked(page: str) -> dict[str, tuple[str, str]]:
    """The colour and the content of the link of each block in the map, by its address."""
    found = re.findall(r'<a href="([^"]*)" data-page="\1" style="color: (#\w{6})">(.*?)</a>', page, re.S)
    return {address: (color, content) for address, color, content in found}


def test_each_block_on_the_map_leads_to_its_own_page_in_the_folder_of_results(page, drive):
    scene, blocks = drive
    assert [*linked(page)] == [f"../../{name}/street/viewer.html" for name in FIGURES]
    files = {address.partition("#")[0] for address in addresses(page) if not address.startswith(NO_FILES)}
    assert files == {*linked(page)} and "://" not in page and "default-src 'none'" in page
    starts = starts_of(scene, blocks)
    frames = {frame.timestamp: frame.ego_to_world[:2, 3] for frame in scene.frames}
    for number, (name, (_, content)) in zip((0, 1, 3), zip(FIGURES, linked(page).values(), strict=True), strict=True):
        ((places, seconds),) = lines_in(content)
        own = blocks.blocks[number].core[0]
        inside = [place for time, place in frames.items() if own[0] <= time < own[1]]
        assert len(places) == len(inside) and np.allclose(places, inside, atol=0.06)
        times = starts[name] + np.round(seconds * 1e6).astype(int)
        assert [blocks.at(time) for time in times.tolist()] == [number] * len(times)
        assert np.allclose(places, [frames[time] for time in times.tolist()], atol=0.06)


def test_colours_follow_the_figures_and_blocks_that_are_left_out_are_named(page):
    low, high, unknown = (color for color, _ in linked(page).values())
    assert (low, high, unknown) == ("#e66101", "#2b83ba", GREY)
    assert "linear-gradient(to right, #e66101, #9e66ab, #2b83ba)" in page
    assert "Left out: long.002." in page and "long.002, left out" in page
    absent = re.search(r'<g class="absent"[^>]*>(.*?)</g>', page, re.S)[1]
    assert len(lines_in(absent)[0][0]) == 100, "its path is drawn, too"


def rows(page: str) -> list[list[str]]:
    """The cells of the table, without their markup."""
    found = re.findall(r"<tr>\n(.*?)</tr>", page, re.S)
    cells = [re.findall(r"<td>(.*?)</td>", row, re.S) for row in found]
    return [[" ".join(re.sub(r"<[^>]*>", "", cell).split()) for cell in row] for row in cells]


def test_the_table_has_length_gaussians_figures_and_times_of_each_block(page):
    assert rows(page) == [
        ["long.000", "100 m", "1,234", "25.00 dB", "0.0 – 10.0"],
        ["long.001", "100 m", "1,235", "30.00 dB", "10.0 – 20.0"],
        ["long.002, left out", "100 m", "–", "–", "20.0 – 30.0"],
        ["long.003", "99 m", "1,236", "–", "30.0 – 39.9"],
    ]
    text = " ".join(page.split())
    assert "399 m in 40 s, 4 blocks, 98,765 Gaussians; PSNR of static pixels 27.12 dB." in text
    begins = re.search(r'"../../long.001/street/viewer.html#second=(.*?)&amp;following=yes">10.0 – 20.0</a>', page)
    assert float(begins[1]) == pytest.approx(2.0, abs=0.11), "its own path begins behind the overlap"


def test_a_street_that_is_driven_twice_is_one_block_with_two_lines_and_two_times():
    corners = np.array([[0, 0], [100, 0], [100, 100], [0, 100]])
    around = [np.linspace(corners[i % 4], corners[(i + 1) % 4], 100, endpoint=False) for i in range(8)]
    scene = drive_along(np.concatenate(around))
    blocks = cut(scene)
    page = page_of(scene, blocks, measured(dict.fromkeys(blocks.names, 20.0)))
    for (_, content), row, block in zip(linked(page).values(), rows(page), blocks.blocks, strict=True):
        assert len(lines_in(content)) == len(block.core) == row[4].count("–")
        driven = sum(np.diff(block.core).ravel()) * 1e-6 * 10.0
        assert float(row[1].removesuffix(" m")) == pytest.approx(driven, abs=3.0)
    assert min(len(block.core) for block in blocks.blocks) == 2, "twice around"
    assert {color for color, _ in linked(page).values()} == {"#9e66ab"}, "all have the same figure"


def test_a_jump_is_no_metre_that_was_driven_and_names_are_escaped():
    scene = drive_along(np.concatenate([straight(100), straight(5100, start=5000.0)]))
    blocks = cut(scene)
    page = page_of(scene, blocks, measured(dict.fromkeys(blocks.names, 20.0)))
    assert [row[1] for row in rows(page)] == ["99 m", "99 m"] and "198 m in 20 s, 2 blocks" in " ".join(page.split())
    assert "</script><b>" not in page


def test_a_drive_without_any_figure_has_a_grey_map_without_a_scale(drive):
    record = measured(dict.fromkeys(drive[1].names))
    record["result"]["interpolation"] = {"static": None}
    page = page_of(*drive, record)
    assert {color for color, _ in linked(page).values()} == {GREY} and "Colours:" not in page
    assert "PSNR of static pixels –." in " ".join(page.split())


@pytest.mark.skipif(NODE is None, reason="no Node here")
def test_a_click_on_the_path_opens_the_block_at_the_time_of_the_nearest_place():
    """By Node, with a map whose metres are half pixels, and a block that is driven twice."""
    script = (Path(drive_page.__file__).parent / "map.js").read_text(encoding="utf-8")
    stand_in = """
      class DOMPoint {
        constructor(x, y) { this.x = x; this.y = y; }
        matrixTransform(scale) { return new DOMPoint(this.x * scale, this.y * scale); }
      }
      const line = (places, seconds) => ({ points: places.map(([x, y]) => ({ x, y })), dataset: { seconds } });
      const lines = [line([[0, 0], [10, 0], [20, 0]], "0.50 1.50 2.50"), line([[20, 3], [0, 3]], "40.00 42.00")];
      const link = {
        dataset: { page: "../../a.001/street/viewer.html" },
        querySelectorAll: () => lines,
        addEventListener(kind, call) { this[kind] = call; },
        setAttribute(name, value) { this[name] = value; },
      };
      followPointer({ querySelectorAll: () => [link], getScreenCTM: () => ({ inverse: () => 0.5 }) });
      const found = [[21, 1], [38, 8]].map(([clientX, clientY]) => {
        link.pointerdown({ clientX, clientY });
        return link.href;
      });
      console.log(JSON.stringify(found));
    """
    done = subprocess.run([str(NODE), "-"], input=script + stand_in, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [
        "../../a.001/street/viewer.html#second=1.50&following=yes",
        "../../a.001/street/viewer.html#second=40.00&following=yes",
    ]


@in_a_browser
def test_in_a_browser_the_map_leads_to_the_time_under_the_pointer(page, tmp_path):
    file = tmp_path / "long/street/viewer.html"
    file.parent.mkdir(parents=True)
    file.write_text(page, encoding="utf-8")
    with chromium(tmp_path / "profile") as tab:
        tab.open(file, 1300, 900)
        x, y = tab.run(
            "(() => { const line = document.querySelectorAll('#map a polyline')[1];"
            " const at = line.points[50].matrixTransform(line.getScreenCTM()); return [at.x, at.y]; })()"
        )
        tab.mouse("mousePressed", round(x), round(y), button="left", clickCount=1)
        address = tab.run("document.querySelectorAll('#map a')[1].getAttribute('href')")
        assert tab.complaints == [] and len(tab.requests) == 1
    second = float(re.fullmatch(r"\.\./\.\./long\.001/street/viewer\.html#second=([\d.]+)&following=yes", address)[1])
    assert second == pytest.approx(7.0, abs=0.3), "the block begins two seconds before its own path"
