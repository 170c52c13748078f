"""Costs of long drives: what blocks took, what a longer recording would take, and what runs say of both."""

import json
from pathlib import Path

import pytest
import yaml
from helpers import REPOSITORY

from drivesplat.cli.__main__ import main
from drivesplat.errors import RequestError, ResultError
from drivesplat.settings.config import load, merged
from drivesplat.workflow.costs.block_costs import PaperRecording, chosen_costs, measured_drives, on_paper
from drivesplat.workflow.costs.estimate import Expectations, Machine, PlannedJob, spelled, wall_seconds
from drivesplat.workflow.costs.measured import Cost, JobId
from drivesplat.workflow.costs.table import costs_in_words, costs_record

S = 1_000_000
SECONDS = {"train": 20.0, "evaluate": 4.0, "masks": 3.0, "lidar_seed": 2.0, "film_original": 50.0}
IMAGES, SIZE = 40, (800, 450)
RECORDING = PaperRecording(hours=1.0, cameras=6, size=(1600, 900), hz=10.0, speed_kmh=36.0)


def benchmark(results: Path, name: str, seconds: float) -> None:
    path = results / "benchmarks" / f"{name}.tsv"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"s\th:m:s\tmax_rss\n{seconds}\t0:00:10\t500.0\n")


def write(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def block(results: Path, name: str, seconds: dict[str, float] = SECONDS, method: str = "street") -> None:
    """The measured results of a block: 1,000 bytes of the method beside its records, and 5,000 of the scene."""
    for stage, value in seconds.items():
        benchmark(results, f"{name}/{'' if stage in ('masks', 'lidar_seed') else f'{method}/'}{stage}", value)
    folder = results / name / method
    train = {"seconds": 19.0, "iterations": 3000, "resumed_at": [], "peak_gpu_memory_gb": 1.0, "device": "NVIDIA H200"}
    write(folder / "train.json", train)
    protocol = {"cameras": ["front", "rear"], "train_images": IMAGES, "width": SIZE[0], "height": SIZE[1]}
    write(folder / "eval.json", {"protocol": protocol})
    (folder / "checkpoint.npz").write_bytes(bytes(1000))
    (results / name / "masks").mkdir()
    (results / name / "masks/masks.json").write_bytes(bytes(5000))


@pytest.fixture
def results(tmp_path) -> Path:
    """Two measured blocks of a drive of three, each of 10 s of its path and 5 s of overlaps."""
    blocks = [
        {"core": [[10 * i * S, 10 * (i + 1) * S]], "used": [[(10 * i - 2) * S, (10 * i + 13) * S]]} for i in range(3)
    ]
    settings = {"blocks": {"length_m": 150.0, "overlap_m": 40.0, "same_place_m": 6.0}}
    write(
        tmp_path / "way/blocks.json", {"blocks": blocks, "provenance": {"stages": {"blocks": {"settings": settings}}}}
    )
    (tmp_path / "way/scene.json").write_bytes(bytes(8000))
    benchmark(tmp_path, "way/extract", 16.0)
    benchmark(tmp_path, "way/street/film_original", 500.0)
    block(tmp_path, "way.000")
    block(tmp_path, "way.001", {**SECONDS, "train": 30.0})
    return tmp_path


def test_the_means_of_measured_blocks_are_what_their_jobs_took_and_left(results):
    (found,) = measured_drives(results)
    assert (found.drive, found.method, found.blocks, found.length_m, found.overlap_m) == (
        "way",
        "street",
        2,
        150.0,
        40.0,
    )
    assert (found.train_seconds, found.evaluate_seconds, found.other_seconds) == (25.0, 4.0, 5.0), "no films"
    assert (found.images, found.size, found.iterations, found.devices) == (40.0, SIZE, (3000,), ("NVIDIA H200",))
    assert found.model_gb == pytest.approx(1.0 - 40 * 800 * 450 * 3e-9) and found.scene_bytes == 5000.0
    records = (results / "way.000/street").glob("*.json")
    assert found.method_bytes == 1000.0 + sum(file.stat().st_size for file in records)
    images = 2 * 40 * 30 / 30  # of 30 s of the drive, by those of the 30 s that both blocks use
    of_drive = 8000 + (results / "way/blocks.json").stat().st_size
    assert (found.drive_seconds_per_image, found.drive_bytes_per_image) == (16.0 / images, of_drive / images)


def test_a_chosen_length_is_that_of_the_record(results):
    file = results / "way/blocks.json"
    record = json.loads(file.read_text())
    record["provenance"]["stages"]["blocks"]["settings"]["blocks"]["length_m"] = "auto"
    file.write_text(json.dumps({**record, "length_m": 120.0, "reason": "memory"}))
    (found,) = measured_drives(results)
    assert (found.length_m, found.overlap_m) == (120.0, 40.0)


def test_a_longer_recording_takes_between_what_blocks_took_and_that_in_proportion_to_images(results):
    (costs,) = measured_drives(results)
    least, most = on_paper(RECORDING, costs)
    images = 6 * 10 * 230 / 10  # on 230 m at 10 m/s
    share, whole = 4.0 * images / 40, 6 * 10 * 3600
    for found in (least, most):
        assert (found.blocks, found.images) == (36_000 / 150, images)
        assert found.memory_gb == pytest.approx(costs.model_gb + images * 1600 * 900 * 3e-9)
        of_drive = 4.0 * whole * costs.drive_bytes_per_image
        assert found.disk == pytest.approx(240 * (costs.method_bytes + share * 5000.0) + of_drive)
    assert (least.device_seconds, least.other_seconds) == (29.0, 5.0)
    assert most.device_seconds == pytest.approx(4.0 * 25.0 + share / 3 * 4.0)
    assert most.other_seconds == pytest.approx(share * 5.0)
    assert [one.first_seconds for one in (least, most)] == pytest.approx([whole * 16.0 / 80, 4.0 * whole * 16.0 / 80])
    before = most.first_seconds + most.other_seconds
    for cards, per_card, rounds in ((1, 1, 240), (8, 1, 30), (64, 1, 4), (8, 6, 5), (240, 1, 1), (999, 1, 1)):
        assert most.wall_seconds(cards, per_card) == pytest.approx(before + rounds * most.device_seconds)
    smaller = PaperRecording(hours=1.0, cameras=2, size=(400, 225), hz=1.0, speed_kmh=36.0)
    least, most = on_paper(smaller, costs)
    assert least.device_seconds < most.device_seconds == 29.0


def test_a_recording_like_the_measured_one_takes_what_that_took(results):
    (costs,) = measured_drives(results)
    same = PaperRecording(hours=30 / 3600, cameras=2, size=SIZE, hz=20 / 15, speed_kmh=3.6 * 230 / 15)
    for found in on_paper(same, costs):
        assert (found.images, found.device_seconds, found.other_seconds) == pytest.approx((40.0, 29.0, 5.0))
        assert found.first_seconds == pytest.approx(16.0) and found.memory_gb == pytest.approx(1.0)


def test_the_command_prints_what_it_knows_and_how(results, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    line = ["estimate", "--hours", "1", "--cameras", "6", "--size", "1600x900", "--hz", "10", "--speed-kmh", "36"]
    assert main([*line, "--cards", "1,64", "--results", str(results)]) == 0
    said = capsys.readouterr().out
    measured = "(NVIDIA H200; 3,000 iterations; 40 images of 800x450 in a block)"
    assert f"street, by 2 measured blocks of way in {results}/ {measured}" in said
    assert "36.0 km in 240 blocks of 150 m with 1,380 images of 1600x900 each" in said
    least, most = on_paper(RECORDING, measured_drives(results)[0])
    hours = [f"{240 * found.device_seconds / 3600:.1f}" for found in (least, most)]
    assert f"all blocks: {hours[0]} to {hours[1]} GPU hours, " in said
    for cards, name in ((1, "1 GPU"), (64, "64 GPUs")):
        walls = [spelled(found.wall_seconds(cards, 1)) for found in (least, most)]
        assert f"wall time on {name}: {walls[0]} to {walls[1]}\n" in said
    assert f"disk: {least.disk * 1e-9:,.1f} GB" in said
    assert main([*line, "--results", str(results), "--per-card", "6"]) == 0
    assert "GPU hours (6 trainings at a time)" in capsys.readouterr().out
    same = ["--cameras", "2", "--hz", str(20 / 15), "--speed-kmh", str(3.6 * 230 / 15)]
    assert main(["estimate", "--hours", "0.5", *same, "--results", str(results)]) == 0
    assert "a block: 29 s of training and evaluation, 5 s of other jobs, 1.0 GB of GPU" in capsys.readouterr().out


def test_without_measured_blocks_nothing_is_invented(results, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = measured_drives(results)
    with pytest.raises(RequestError, match=r"has no measured blocks of other, .* there are: way \(street, 2 blocks\)"):
        chosen_costs(found, results, "other", None)
    empty = tmp_path / "empty"
    assert main(["estimate", "--hours", "1", "--hz", "2", "--speed-kmh", "40", "--results", str(empty)]) == 1
    said = capsys.readouterr()
    assert (
        said.out == ""
        and "has no measured blocks, by which longer recordings are estimated; there are: none" in said.err
    )
    for wrong in (["--hours", "0"], ["--size", "1600"], ["--cards", "1,x"], ["--speed-kmh", "-3"]):
        with pytest.raises(SystemExit):
            main(["estimate", "--hours", "1", "--hz", "2", "--speed-kmh", "40", *wrong])
    (results / "way/blocks.json").write_text('{"blocks": [{}, {}, {}], "provenance": {}}')
    with pytest.raises(ResultError, match=r"way/blocks.json: not the record of blocks"):
        measured_drives(results)


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"frames": []}', '{"protocol": null}', '{"protocol": {"width": 800, "height": "tall"}}']
)
def test_a_damaged_evaluation_of_a_block_is_named_itself(results, content):
    file = results / "way.001/street/eval.json"
    file.write_text(content)
    with pytest.raises(ResultError) as raised:
        measured_drives(results)
    assert str(raised.value).startswith(f"{file}: ") and "the rule 'evaluate' rebuilds it" in str(raised.value)


def config() -> object:
    defaults = yaml.safe_load((REPOSITORY / "config.yaml").read_text())
    cut = {"reader": "drive", "scenes": ["way", "back"], "blocks": {"length_m": 100.0}}
    return load(merged(defaults, {"datasets": {"cut": cut}}))


def test_blocks_are_estimated_by_blocks_and_drives_by_drives(tmp_path):
    costs = [
        Cost(JobId("masks", "way.000"), 3.0, ""),
        Cost(JobId("masks", "0061"), 900.0, ""),
        Cost(JobId("film", "way.001", "street", "original"), 10.0, ""),
        Cost(JobId("film", "back", "street", "original"), 400.0, ""),
    ]
    known = Expectations(config(), costs)
    assert known.of(JobId("masks", "back.007")) == (3.0, {costs[0].job})
    assert known.of(JobId("film", "way", "street", "original")) == (400.0, {costs[3].job})
    assert known.of(JobId("film", "way.000", "street", "original"))[0] == 10.0
    for name, size in (("way.000", 1000), ("back.003", 3000), ("0061.000", 9)):
        (tmp_path / name / "street").mkdir(parents=True)
        (tmp_path / name / "street/checkpoint.npz").write_bytes(bytes(size))
    path = str(tmp_path / "way.001/street/checkpoint.npz")
    assert known.disk_bytes(PlannedJob(JobId("train", "way.001", "street"), 1, True, (path,)), tmp_path) == 2000.0


def test_blocks_wait_for_the_stages_of_their_drive():
    extract = PlannedJob(JobId("extract", "way"), 1, False, seconds=50.0)
    blocks = [PlannedJob(JobId("train", f"way.00{i}", "street"), 1, True, seconds=100.0) for i in range(3)]
    assert wall_seconds([extract, *blocks], Machine(64, 64)) == 150.0


def test_the_costs_of_a_drive_are_those_of_its_blocks(results):
    record = costs_record(results, ["street"], cut=["way"])
    (drive,) = record["drives"]
    assert (drive["drive"], drive["blocks"], drive["training_seconds"], drive["gpu_memory_gb"]) == ("way", 2, 50.0, 1.0)
    assert drive["seconds"] == 16.0 + 500.0 + sum(SECONDS.values()) * 2 + 10.0
    files = [file for name in ("way", "way.000", "way.001") for file in (results / name).rglob("*") if file.is_file()]
    assert drive["bytes"] == sum(file.stat().st_size for file in files)
    said = costs_in_words(record)
    assert "drive way with 2 blocks: 11.4 min of jobs, 0.8 of them trainings, at most 1.0 GB of GPU memory, " in said
    assert costs_record(results, ["street"])["drives"] == []
