"""A library of assets: what is collected in it, under which names, and what its index and its page say."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.chromium import chromium, in_a_browser
from helpers.hand_made_assets import asset_of, filled_car, round_ones
from PIL import Image

from drivesplat.editing.assets.asset import TURNTABLE, Asset, read_asset, write_asset
from drivesplat.editing.assets.asset_library import AssetLibrary, library_name
from drivesplat.editing.assets.collection import collect_assets
from drivesplat.editing.assets.exchange import ImportOptions, import_assets
from drivesplat.editing.assets.library import read_inserts
from drivesplat.editing.assets.library_entry import mean_psnr, read_entry, seen_fraction
from drivesplat.errors import DriveSplatError, RequestError
from drivesplat.model.splat_ply import write_splat_ply
from drivesplat.scene.object_class import ObjectClass
from drivesplat.settings.asset_references import PLY, RECORD
from drivesplat.settings.edit import Edit

PERSON = np.array([0.6, 0.6, 1.8])
GROUPS = {"interpolation": {"psnr": 20.0, "images": 3}, "extrapolation": {"psnr": 24.0, "images": 1}}


def put(results: Path, scene: str, method: str, track: str, **changes: Any) -> Path:
    """Writes an asset as the stage does, with a red turntable, and adds it to the index."""
    folder = results / scene / method / "assets"
    source = {"dataset": "tiny", "scene": scene, "method": method, "track": track}
    asset = filled_car(20, 1, **{"name": f"{scene}/{method}/{track}", "source": source, **changes})
    write_asset(folder / track, asset)
    frames = [Image.new("RGB", (32, 24), (200, 10 * i, 0)) for i in range(5)]
    frames[0].save(folder / track / TURNTABLE, save_all=True, append_images=frames[1:])
    tracks = sorted({path.parent.name for path in folder.glob(f"*/{RECORD}")})
    records = {"assets": [{"track": track, "folder": track} for track in tracks]}
    (folder / "assets.json").write_text(json.dumps(records))
    return folder / track


@pytest.fixture
def results(tmp_path) -> Path:
    """Two cars of a scene, one of them by two methods, and a person of another scene."""
    results = tmp_path / "results"
    put(results, "0061", "street", "6e5c", quality=GROUPS, seen=np.array([0.0]))
    put(results, "0061", "street", "9e02", seed=6)
    put(results, "0061", "lidar", "6e5c", seed=7, quality={"interpolation": {"psnr": 30.0, "images": 2}})
    person = {"object_class": ObjectClass.PEDESTRIAN, "size": PERSON, "category": "human.adult"}
    put(results, "0103", "street", "3c1f", seed=8, **person)
    return results


def index_of(library: Path) -> list[dict[str, Any]]:
    content = json.loads((library / "library.json").read_text())
    assert content["schema"] == 1
    return content["assets"]


def names_of(library: Path) -> list[str]:
    return [own["id"] for own in index_of(library)]


# ---- collecting


def test_assets_of_all_scenes_and_methods_come_together(results, tmp_path):
    library = tmp_path / "library"
    collected = collect_assets(results, library)
    names = ["0061_lidar_6e5c", "0061_street_6e5c", "0061_street_9e02", "0103_street_3c1f"]
    assert (collected.added, collected.total, names_of(library)) == (4, 4, names)
    for file in (PLY, RECORD, TURNTABLE):
        own = library / "0061_street_6e5c" / file
        assert own.read_bytes() == (results / "0061/street/assets/6e5c" / file).read_bytes()
    (entry,) = (own for own in index_of(library) if own["id"] == "0061_street_6e5c")
    assert entry.pop("mean_color") and entry == {
        "id": "0061_street_6e5c", "class": "car", "category": "vehicle.car", "size": [4.0, 2.0, 1.5], "gaussians": 20,
        "sh_degree": 1, "invented": 0.0, "seen": 0.417, "psnr": 21.0, "lidar": False, "walks": False,
        "source": {"dataset": "tiny", "scene": "0061", "method": "street", "track": "6e5c"},
        "thumbnail": "0061_street_6e5c/thumbnail.webp", "turntable": "0061_street_6e5c/turntable.webp",
    }  # fmt: skip
    with Image.open(library / entry["thumbnail"]) as picture:
        assert picture.size == (200, 150) and abs(picture.convert("RGB").getpixel((9, 9))[1] - 30) < 12


def test_collecting_again_adds_what_is_new_and_keeps_what_is_there(results, tmp_path):
    library = tmp_path / "library"
    collect_assets(results, library)
    before = (library / "0061_street_9e02" / PLY).stat().st_mtime_ns
    put(results, "0061", "street", "6e5c", seed=12)
    put(results, "0061", "street", "aaaa", seed=13)
    shutil.rmtree(results / "0103")
    collected = collect_assets(results, library)
    assert (collected.added, collected.replaced, collected.kept, collected.total) == (1, 1, 2, 5)
    assert collected.words.startswith("1 added, 1 replaced, 2 unchanged, 0 left out; the library has 5")
    assert (library / "0061_street_9e02" / PLY).stat().st_mtime_ns == before and "0103_street_3c1f" in names_of(library)
    new = read_asset(library / "0061_street_6e5c").gaussians.means
    torch.testing.assert_close(new, read_asset(results / "0061/street/assets/6e5c").gaussians.means)
    shutil.rmtree(library / "0061_street_aaaa")
    assert [own.id for own in AssetLibrary(library).write_index()] == names_of(library) and len(names_of(library)) == 4


def test_classes_and_the_psnr_choose(results, tmp_path):
    people = collect_assets(results, tmp_path / "people", classes=["pedestrian"])
    assert (people.added, people.left_out, names_of(tmp_path / "people")) == (1, 3, ["0103_street_3c1f"])
    collect_assets(results, tmp_path / "good", min_psnr=21.0)
    assert names_of(tmp_path / "good") == ["0061_lidar_6e5c", "0061_street_6e5c"]
    collect_assets(results, tmp_path / "both", classes=["car", "bus"], min_psnr=25.0)
    assert names_of(tmp_path / "both") == ["0061_lidar_6e5c"]
    assert collect_assets(results, tmp_path / "none", min_psnr=99.0).words.endswith("4 left out; the library has 0")


def test_a_turntable_that_is_gone_is_gone_from_the_library(results, tmp_path):
    collect_assets(results, tmp_path / "library")
    (put(results, "0061", "street", "9e02", seed=14) / TURNTABLE).unlink()
    collect_assets(results, tmp_path / "library")
    (entry,) = (own for own in index_of(tmp_path / "library") if own["id"] == "0061_street_9e02")
    assert entry["thumbnail"] is None and entry["turntable"] is None


def test_an_asset_of_the_library_is_inserted_by_its_path(results, tmp_path, monkeypatch):
    collect_assets(results, tmp_path / "library")
    monkeypatch.chdir(tmp_path)
    name = "./library/0061_street_9e02"
    step = {"insert": {"asset": name, "as": "new", "at": [9, 0]}}
    inserts = read_inserts(Edit.model_validate({"steps": [step]}), results / "0103/street")
    assert inserts.assets[name].name == "0061/street/9e02"


# ---- what is refused


def said_of(*arguments: Any, **options: Any) -> str:
    with pytest.raises(DriveSplatError) as refused:
        collect_assets(*arguments, **options)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_results_without_assets_and_unknown_classes_are_refused(results, tmp_path):
    (tmp_path / "empty").mkdir()
    assert said_of(tmp_path / "empty", tmp_path / "library") == (
        f"{tmp_path / 'empty'} has no assets: `snakemake --cores 4 assets` makes them"
    )
    assert said_of(tmp_path / "none", tmp_path / "library") == f"there is no folder {tmp_path / 'none'}"
    assert "there is no class 'dragon'; known are car, truck" in said_of(results, tmp_path / "l", classes=["dragon"])
    assert not (tmp_path / "library").exists()


def test_the_name_of_another_asset_is_taken(results, tmp_path):
    library = tmp_path / "library"
    collect_assets(results, library)
    other = {"dataset": "other", "scene": "0061", "method": "street", "track": "6e5c"}
    put(results, "0061", "street", "6e5c", seed=21, source=other)
    said = said_of(results, library)
    assert "the name '0061_street_6e5c' is taken" in said and "(dataset tiny, scene 0061, method street" in said
    write_splat_ply(tmp_path / "0103_street_3c1f.ply", filled_car(60).gaussians, {})
    with pytest.raises(RequestError, match="the name '0103_street_3c1f' is taken"):
        import_assets(tmp_path / "0103_street_3c1f.ply", library, ImportOptions("ply", "x,y,z", 1.0, None, "car"))


def test_two_assets_of_one_name_are_refused(results, tmp_path):
    put(results, "0061_street", "6e5c", "b")
    put(results, "0061", "street_6e5c", "b")
    assert "would both be called '0061_street_6e5c_b'" in said_of(results, tmp_path / "library")


def test_folders_of_other_files_are_no_library(results, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/index.html").write_text("mine")
    assert "is not a library: it has no library.json" in said_of(results, tmp_path / "mine")
    assert (tmp_path / "mine/index.html").read_text() == "mine"
    collect_assets(results, tmp_path / "library")
    half_written = tmp_path / "library/0061_street_new"
    half_written.mkdir()
    (half_written / PLY).write_bytes(b"ply")
    put(results, "0061", "street", "new")
    (half_written / "notes.txt").touch()
    assert "is taken in" in said_of(results, tmp_path / "library")
    (half_written / "notes.txt").unlink()
    assert collect_assets(results, tmp_path / "library").added == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [('{"schema": 2}', "its schema is 2, not 1"), ("[]", "its schema is None"), ("{", "not a readable JSON file")],
)
def test_a_library_of_another_version_is_refused(text, said, results, tmp_path):
    collect_assets(results, tmp_path / "library")
    (tmp_path / "library/library.json").write_text(text)
    assert f"library.json: {said}" in said_of(results, tmp_path / "library")


def test_damaged_assets_are_refused_before_they_are_copied(results, tmp_path):
    folder = results / "0061/lidar/assets/6e5c"
    record = json.loads((folder / RECORD).read_text())
    for changed, said in (
        ({"schema": 2}, "its schema is 2, not 1; make the asset again"),
        ({"class": "dragon"}, "not the record of an asset ('dragon'"),
        ({"size": [4, 2]}, "is not three numbers"),
        ({"frame": {}}, "it does not declare the frame"),
        ({"size": [400, 2, 1]}, "does not fit its class"),
    ):
        (folder / RECORD).write_text(json.dumps({**record, **changed}))
        assert said in said_of(results, tmp_path / "library")
    (folder / RECORD).write_text("{")
    assert "not a readable JSON file" in said_of(results, tmp_path / "library")
    (folder / RECORD).write_text(json.dumps(record))
    (folder / PLY).write_bytes(b"ply")
    assert "not a splat" in said_of(results, tmp_path / "library")
    assert not list(tmp_path.glob("library/*_*"))


@pytest.mark.parametrize("folder", ["../../../../outside", "/outside", "a/b", "..", ""])
def test_an_index_of_results_that_leads_elsewhere_is_refused(folder, results, tmp_path):
    index = results / "0061/lidar/assets/assets.json"
    index.write_text(json.dumps({"assets": [{"track": "6e5c", "folder": folder}]}))
    said = said_of(results, tmp_path / "library")
    assert said.startswith(f"{index}: ") and f"{folder!r} is not a folder beside it" in said


def test_names_are_valid_everywhere():
    assert library_name("0061_street_a b/ü..") == "0061_street_a_b____"
    assert library_name("../x") == "x" and library_name("_-car") == "car"
    with pytest.raises(RequestError, match="has neither letter nor digit"):
        library_name("../..")


# ---- figures


def test_the_seen_fraction_counts_sides_within_75_degrees():
    assert seen_fraction(np.zeros(0)) is None
    assert seen_fraction(np.array([1.0])) == pytest.approx(150.0 / 360.0, abs=0.01)
    assert seen_fraction(np.array([0.0, np.pi / 2.0])) == pytest.approx(240.0 / 360.0, abs=0.01)
    assert seen_fraction(np.radians([0.0, 120.0, 240.0])) == 1.0


def test_the_psnr_is_weighted_by_images():
    assert mean_psnr(GROUPS) == 21.0
    assert mean_psnr({}) is None and mean_psnr({"a": {"psnr": None, "images": 2}}) is None


def test_a_record_by_hand_is_enough(tmp_path):
    """The one of docs/assets.md."""
    folder = tmp_path / "library/my_car"
    write_asset(folder, filled_car(30))
    text = (Path(__file__).parents[2] / "docs/assets.md").read_text()
    (folder / RECORD).write_text(text[text.rindex("```json") + 7 : text.rindex("```")])
    entry = read_entry(folder)
    assert (entry.object_class, entry.seen, entry.psnr, entry.origin) == (ObjectClass.CAR, None, None, "")
    assert read_asset(folder).name == "my_car"


# ---- the page


def small_car(name: str, **changes: Any) -> Asset:
    return asset_of(round_ones([[0.0, 0.0, 0.0], [1.5, 0.5, 0.3]], (0.8, 0.1, 0.1), 0.3), name=name, **changes)


def write_two_pictures(path: Path, asset: Asset) -> None:
    path.parent.mkdir(exist_ok=True)
    frames = [Image.new("RGB", (32, 24), (0, 100 * i, 0)) for i in range(2)]
    frames[0].save(path, save_all=True, append_images=frames[1:])


def test_the_page_shows_every_asset_and_needs_no_network(results, tmp_path, monkeypatch):
    monkeypatch.setattr("drivesplat.editing.assets.asset_library.write_turntable", write_two_pictures)
    library = tmp_path / "my library"
    collect_assets(results, library)
    evil = small_car("x", category='<script>alert("1")</script>', source={"file": "<b>"})
    AssetLibrary(library).add("evil", evil)
    AssetLibrary(library).write_index()
    page = (library / "index.html").read_text()
    assert page.count("<article") == 5 == page.count('src="data:image/webp;base64,')
    assert "<script>alert" not in page and "http" not in page.replace("http-equiv", "")
    for words in ("4.00 × 2.00 × 1.50 m", "21.0 dB", "42%", "scene 0061, method street", "pedestrian (1)", "car (4)"):
        assert words in page, words
    assert "asset: ./my library/0061_street_9e02" in page
    with Image.open(library / "evil/thumbnail.webp") as picture:
        assert picture.convert("RGB").getpixel((9, 9))[1] > 80, "the last picture, of fewer than four"


@in_a_browser
def test_the_page_filters_by_class_and_turns_what_is_pointed_at(results, tmp_path):
    collect_assets(results, tmp_path / "library")
    shown = "[...document.querySelectorAll('article')].filter((a) => a.offsetParent).length"
    with chromium(tmp_path / "profile") as tab:
        tab.open(tmp_path / "library/index.html", 1200, 800)
        assert tab.run(shown) == 4
        tab.run(
            "const s = document.getElementById('class'); s.value = 'pedestrian'; s.dispatchEvent(new Event('change'))"
        )
        assert tab.run(shown) == 1
        tab.run("document.querySelector('article:not([hidden])').dispatchEvent(new Event('pointerenter'))")
        assert tab.run("document.querySelector('article:not([hidden]) img').src").endswith("3c1f/turntable.webp")
        tab.run("document.querySelector('article:not([hidden])').dispatchEvent(new Event('pointerleave'))")
        assert tab.run("document.querySelector('article:not([hidden]) img').src").startswith("data:image/webp")
        assert not tab.complaints and all(own.startswith(("file:", "data:")) for own in tab.requests)
