"""A drive that is cut into blocks, run as users run it; and the same drive when it has become longer."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.drives import World, write_world
from helpers.shared_runs import TWO_METHODS, VANILLA
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy
from plyfile import PlyData
from pxr import Usd, UsdGeom, UsdVol

import drivesplat
from drivesplat.cli.__main__ import main

pytestmark = pytest.mark.workflow
INDEX = "results/0001/vanilla/splats/splats.json"
TARGETS = ("results/0001/metrics.json", "results/0001/vanilla/original.mp4", INDEX)


def world(key_frames: int) -> World:
    return World(speed=10.0, key_frames=key_frames)


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    made = WorkflowCopy.make(
        tmp_path_factory.mktemp("long"),
        world(16),
        datasets={
            "nuscenes": {"dataroot": "data", "scenes": ["0001"], "blocks": {"length_m": 30.0, "overlap_m": 10.0}}
        },
        methods=VANILLA,
        holdout={"every_nth": 5, "offset": 2, "last_block": 1},
        train={**TINY_TRAINING, "iterations": 20},
    )
    done = made.run(*TARGETS)
    (made.folder / "first_run.txt").write_text(done.stdout)
    return made


def test_a_run_that_cuts_a_drive_says_that_it_does_not_know_the_blocks_yet(copy):
    said = (copy.folder / "first_run.txt").read_text()
    assert "drivesplat: the blocks of scene 0001 are not known yet, and their jobs are not in the estimate" in said
    assert "blocks of scene 0001 are not known yet" not in copy.run("estimate", TARGETS[0]).stdout


def frames_of(film: Path) -> list[np.ndarray]:
    """The frames (h, w, 3) of a film."""
    reader, found = cv2.VideoCapture(str(film)), []
    while (read := reader.read())[0]:
        found.append(read[1])
    return found


def trained(copy: WorkflowCopy) -> dict[str, int]:
    """When each block was trained (ns)."""
    files = Path(copy.folder, "results").glob("0001.*/vanilla/checkpoint.npz")
    return {file.parents[1].name: file.stat().st_mtime_ns for file in sorted(files)}


def test_a_drive_becomes_blocks_that_are_measured_together_and_shown_in_one_film(copy):
    assert list(trained(copy)) == ["0001.000", "0001.001", "0001.002"]
    record = copy.read("results/0001/metrics.json")
    found = record["methods"]["vanilla"]
    assert found["interpolation"]["all"]["pixels"] == 3 * 96 * 54 and found["blocks"].keys() == trained(copy).keys()
    assert record["protocol"]["held_out_frames"] == {"interpolation": [2, 7, 12], "extrapolation": [15]}
    cameras = copy.read("results/0001/vanilla/original.cameras.json")
    assert cameras["frames"] == 31 and (copy.folder / TARGETS[1]).stat().st_size > 1000
    assert copy.planned(*TARGETS) == {}, "nothing is left to be done"
    drive = drivesplat.LongDrive(copy.folder / "results/0001/vanilla", device="cpu")
    assert drive.render("CAM_FRONT", 0.9 * drive.duration).image.shape == (54, 96, 3)


def test_the_costs_of_the_blocks_tell_those_of_a_longer_drive(copy, capsys):
    asked = ["estimate", "--hours", "0.5", "--cameras", "6", "--hz", "10", "--speed-kmh", "36", "--cards", "1,8"]
    assert main([*asked, "--results", str(copy.folder / "results")]) == 0
    said = capsys.readouterr().out
    assert (
        "vanilla, by 3 measured blocks of 0001 in " in said
        and "(cpu" in said
        and "; 20 iterations; 5 images of 96x54 in a block)" in said
    )
    assert "18.0 km in 600 blocks of 30 m with 300 images of 96x54 each" in said
    assert "wall time on 8 machines: " in said and "GPU memory not measured" in said
    (drive,) = copy.read("results/costs.json")["drives"]
    assert drive["drive"] == "0001" and drive["blocks"] == 3 and drive["bytes"] > 10_000
    with copy.set_to(train={**copy.config["train"], "iterations": 21}):
        estimated = copy.run("estimate", TARGETS[0]).stdout
    assert re.search(r"train +3 x ", estimated) and re.search(r"evaluate +3 x ", estimated), estimated
    assert "not known yet" not in estimated, estimated


def test_every_static_gaussian_of_the_drive_is_in_the_file_of_the_nearest_block(copy):
    index = copy.read(INDEX)
    paths = [np.array(block["path"]) for block in copy.read("results/0001/blocks.json")["blocks"]]
    for number, entry in enumerate(index["blocks"]):
        vertices = PlyData.read(copy.folder / INDEX.replace("splats.json", entry["file"]))["vertex"]
        places = np.stack([vertices["x"], vertices["y"]], axis=1) + entry["translation"][:2]
        apart = [np.linalg.norm(places[:, None] - path, axis=2).min(axis=1) for path in paths]
        assert entry["gaussians"] == len(places) > 50 and (np.argmin(apart, axis=0) == number).mean() > 0.99
        assert vertices["x"].min() == pytest.approx(entry["lower"][0]) and entry["scene"] == f"0001.00{number}"


def test_the_whole_drive_is_one_usd_stage_of_its_blocks(copy):
    made = "results/0001/vanilla/scene.usd"
    assert copy.run(made, INDEX).returncode == 0 and copy.planned(made) == {}
    stage, index = Usd.Stage.Open(str(copy.folder / made)), copy.read(INDEX)
    for prim, entry in zip(stage.GetPrimAtPath("/World/blocks").GetChildren(), index["blocks"], strict=True):
        assert prim.GetDisplayName() == entry["scene"]
        splat = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(f"{prim.GetPath()}/background"))
        places = np.array(splat.GetPositionsAttr().Get())
        assert len(places) == entry["gaussians"], "the same as in splats/"
        bounds = [places.min(axis=0), places.max(axis=0)]
        np.testing.assert_allclose(bounds, [entry["lower"], entry["upper"]], rtol=1e-5)
        moved = UsdGeom.Xformable(prim).GetLocalTransformation().ExtractTranslation()
        assert list(moved) == pytest.approx(entry["translation"])


def test_the_page_of_the_drive_is_made_with_those_of_its_blocks_and_leads_to_them(copy):
    made = "results/0001/vanilla/viewer.html"
    assert copy.run(made).returncode == 0 and copy.planned(made) == {}
    page = (copy.folder / made).read_text(encoding="utf-8")
    links = set(re.findall(r'data-page="([^"]*)"', page))
    assert {(copy.folder / made).parent.joinpath(link).resolve() for link in links} == {
        (copy.folder / f"results/{block}/vanilla/viewer.html").resolve() for block in trained(copy)
    }
    assert all((copy.folder / made).parent.joinpath(link).is_file() for link in links)
    for figures in copy.read("results/0001/metrics.json")["methods"]["vanilla"]["blocks"].values():
        psnr = figures["interpolation"]["static"]
        assert ("<td>–</td>" if psnr is None else f"<td>{psnr:.2f} dB</td>") in page
        assert f"<td>{figures['gaussians']:,}</td>" in page


def test_a_block_that_fails_is_named_and_the_drive_goes_on_without_it(copy):
    before = trained(copy)
    checkpoint, masks = "results/0001.001/vanilla/checkpoint.npz", copy.folder / "results/0001.001/masks/masks.json"
    (copy.folder / checkpoint).unlink()
    content = masks.read_text()
    masks.write_text("{")
    failed = copy.run(*TARGETS, flags=("--keep-going",))
    assert failed.returncode and "blocks failed or were interrupted: 0001.001 (results/logs/0001.001/" in failed.stdout
    assert "or go on without them as docs/long_drives.md says" in failed.stdout
    masks.write_text(content)
    cut = copy.config["datasets"]["nuscenes"]
    without = {**cut, "blocks": {**cut["blocks"], "leave_out": [1]}}
    with copy.set_to(datasets={"nuscenes": without}):
        planned = copy.planned(*TARGETS)
        assert planned == {"evaluate_blocks": 1, "scene_metrics": 1, "film_blocks": 1, "export_blocks": 1}
        done = copy.run(*TARGETS)
        assert done.returncode == 0, done.stdout
        assert copy.planned(*TARGETS) == {}
    record = copy.read("results/0001/metrics.json")
    assert record["protocol"]["left_out"] == ["0001.001"]
    assert record["methods"]["vanilla"]["blocks"].keys() == {"0001.000", "0001.002"}
    assert copy.read("results/0001/vanilla/original.cameras.json")["left_out"] == ["0001.001"]
    index = copy.read(INDEX)
    assert index["left_out"] == ["0001.001"] and [own["scene"] for own in index["blocks"]] == ["0001.000", "0001.002"]
    assert not (copy.folder / INDEX).with_name("0001.001.ply").exists()
    absent = {**cut, "blocks": {**cut["blocks"], "leave_out": [7]}}
    with copy.set_to(datasets={"nuscenes": absent}):
        refused = copy.run("metrics", flags=("-n",))
    assert "drivesplat: blocks.leave_out names block 7 of scene 0001, which has 3, counted from 0" in refused.stdout
    drive = drivesplat.LongDrive(copy.folder / "results/0001/vanilla", device="cpu")
    assert drive.left_out == [1]
    frames = frames_of(copy.folder / TARGETS[1])
    stamps = copy.read("results/0001/vanilla/original.cameras.json")["timestamps"]
    dark = [np.median(frame) < 40 for frame in frames]
    assert len(frames) == 31 and dark == [drive.blocks.at(stamp) == 1 for stamp in stamps] and 0 < sum(dark) < 31
    planned = copy.planned(*TARGETS)
    assert planned["train"] == 1 and planned["evaluate_blocks"] == 1, "with the block again, it is trained alone"
    assert trained(copy) == {name: time for name, time in before.items() if name != "0001.001"}


def test_a_longer_drive_trains_its_last_block_and_new_ones_alone(copy):
    before = trained(copy)
    write_world(copy.folder / "data", world(24))
    copy.run(*TARGETS)
    after = trained(copy)
    assert list(after) == [f"0001.00{number}" for number in range(4)]
    assert [name for name in before if after[name] != before[name]] == ["0001.002"]
    assert copy.read("results/0001/metrics.json")["protocol"]["held_out_frames"]["extrapolation"] == [23]


def test_results_of_one_block_are_refused_for_the_drive_in_a_sentence(copy):
    result = copy.run("results/0001/vanilla/splat.ply")
    assert "ask for results/0001.000/vanilla/splat.ply; its blocks are 0001.000 to 0001.00" in result.stdout
    assert result.returncode
    said = copy.dry_run("alpasim")
    assert "drivesplat: scene 0001 is cut into blocks: alpasim makes nothing of it; ask for files of blocks" in said


def test_an_edit_of_the_drive_is_planned_from_its_blocks(copy):
    (copy.folder / "edits.yaml").write_text("edits: {gone: [{remove: {track: '0001 instance 0'}}]}")
    named = {"nuscenes": {**copy.config["datasets"]["nuscenes"], "edits": {"0001": "edits.yaml"}}}
    blocks = copy.read("results/0001/blocks.json")["blocks"]
    with copy.set_to(methods=TWO_METHODS, datasets=named):
        planned = copy.planned("results/0001/street/edits/gone.mp4")
        assert planned["edit_blocks"] == 1 and planned["train"] == len(blocks) and "edit" not in planned
        assert copy.planned("results/0001.001/street/splat.ply").keys() >= {"train", "export"}


@pytest.mark.slow
def test_a_run_may_name_a_block(copy):
    (copy.folder / "runs.yaml").write_text(
        "runs: {here: {policy: recorded, methods: [vanilla], scenes: ['0001.001'], seeds: [0]}}"
    )
    with copy.set_to(runs="runs.yaml"):
        done = copy.run("runs")
    assert done.returncode == 0, done.stdout
    (episode,) = copy.read("results/0001.001/vanilla/runs/here.json")["episodes"]
    assert episode["failed"] is None


def test_a_drive_that_is_extracted_by_other_code_keeps_its_blocks_and_its_figures(copy):
    before, path = trained(copy), copy.folder / "drivesplat/readers/nuscenes/reader.py"
    path.write_text(path.read_text() + "\n\nNOTHING_NEW = 1\n")
    assert copy.planned(*TARGETS).get("extract") == 1
    copy.run(*TARGETS)
    assert trained(copy) == before and copy.planned(*TARGETS) == {}
    assert copy.run("report").returncode == 0
    report = copy.read("results/gap_report.json")
    assert [row["scene"] for row in report["rows"]] == ["0001"]


def test_blocks_that_start_from_the_one_before_are_trained_in_turn(copy):
    before, cut = trained(copy), copy.config["datasets"]["nuscenes"]
    blocks = {**cut["blocks"], "init": "previous"}
    with copy.set_to(datasets={"nuscenes": {**cut, "blocks": blocks}}):
        assert copy.planned(TARGETS[0])["train"] == len(before) - 1, "all but the first one"
        done = copy.run(TARGETS[0])
        assert done.returncode == 0, done.stdout
        in_turn = trained(copy)
        assert in_turn["0001.000"] == before["0001.000"] and [*in_turn.values()] == sorted(in_turn.values())
        log = (copy.folder / "results/logs/0001.001/vanilla/train.log").read_text()
        assert "with those of the block before" in log
        with copy.set_to(datasets={"nuscenes": {**cut, "blocks": {**blocks, "leave_out": [1]}}}):
            assert copy.planned(TARGETS[0])["train"] == len(before) - 2, "those behind it"
        assert copy.planned(TARGETS[0]) == {}
        write_world(copy.folder / "data", world(32))
        copy.run(TARGETS[0])
        after = trained(copy)
        assert [name for name in in_turn if after[name] == in_turn[name]] == [*in_turn][:-1]
        assert len(after) > len(in_turn)


def test_the_length_of_blocks_is_chosen_by_memory_and_said(copy):
    made, named = "results/0001/blocks.json", copy.config["datasets"]["nuscenes"]
    with copy.set_to(datasets={"nuscenes": {**named, "blocks": {"length_m": "auto", "memory_gb": 4}}}):
        said = copy.run(made).stdout
        found = copy.read(made)
        assert found["length_m"] == 400.0 and len(found["blocks"]) == 1
        assert "drivesplat: scene 0001: the length of its blocks is chosen by blocks.memory_gb: 4" in said
        assert f"drivesplat: scene 0001: blocks of 400 m: {found['reason']}" in said
        planned = copy.run(TARGETS[0], flags=("-n",)).stdout
        assert f"drivesplat: scene 0001: blocks of 400 m: {found['reason']}" in planned
