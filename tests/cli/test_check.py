"""`drivesplat check` on recordings of every format: what it finds, what it says of methods, and settings that plan."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers import drives
from helpers.bags import TestBag
from helpers.ncore_clips import NAME as CLIP
from helpers.ncore_clips import tables_recording, write_clip
from helpers.waymo_drive import NAME as SEGMENT
from helpers.waymo_drive import tiny_drive
from helpers.waymo_files import write_v1, write_v2
from helpers.workflow_copy import WorkflowCopy

from drivesplat.cli.__main__ import main
from drivesplat.cli.check import command
from drivesplat.preprocess.poses import lens
from drivesplat.readers.drive.write import write_drive
from drivesplat.settings.config import load
from drivesplat.workflow.costs.measured import BENCHMARKS

pytestmark = pytest.mark.usefixtures("uncompared")

WORLD = drives.World(key_frames=6, lidar_between=1)
PRESENT = {
    "tables": ("nuScenes tables", "0001", "CAM_FRONT", "LIDAR_TOP"),
    "drive": ("drive folder", "monday", "CAM_FRONT", "LIDAR_TOP"),
    "waymo_v1": ("Waymo segments", SEGMENT, "FRONT", "TOP"),
    "waymo_v2": ("Waymo segments", SEGMENT, "FRONT", "TOP"),
    "ncore": ("NCore clips", CLIP, "front", "top"),
}
"""The format, the scene, a camera and a LiDAR of each recording of one drive."""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> Path:
    """One drive in each format, in a folder each."""
    root = tmp_path_factory.mktemp("recordings")
    drives.write_world(root / "tables", WORLD)
    scene = drives.scene_at(root / "tables", lidar_sweeps=True)
    write_drive(scene, root / "drive" / "monday")
    recorded, _ = tiny_drive(root / "tables", WORLD, lasers=(1,))
    for name, write in (("waymo_v1", write_v1), ("waymo_v2", write_v2)):
        write(root / name, recorded)
    pytest.importorskip("ncore")
    write_clip(root / "ncore", tables_recording(scene))
    return root


@pytest.fixture(scope="module")
def workflow(tmp_path_factory) -> WorkflowCopy:
    return WorkflowCopy.make(tmp_path_factory.mktemp("workflow") / "copy")


@pytest.fixture(autouse=True)
def without_lens_trials(monkeypatch):
    monkeypatch.setattr(lens, "lens_warnings", lambda scene: [])


@pytest.fixture
def checked(tmp_path, monkeypatch, capsys) -> Callable[..., list[str]]:
    """The lines that a check prints in an empty folder, and the one of an error."""
    monkeypatch.chdir(tmp_path)

    def lines(place: Path, *options: str, status: int = 0) -> list[str]:
        assert main(["check", str(place), *options]) == status
        said = capsys.readouterr()
        return [*said.out.splitlines(), *said.err.splitlines()]

    return lines


def section(lines: list[str], title: str) -> list[str]:
    """The indented lines below a title."""
    start = next(i for i, line in enumerate(lines) if line.startswith(title)) + 1
    end = next((i for i in range(start, len(lines)) if not lines[i].startswith("  ")), len(lines))
    return [line.strip() for line in lines[start:end]]


def proposed(lines: list[str]) -> dict[str, Any]:
    first, last = lines.index("settings to copy:"), next(i for i, line in enumerate(lines) if "mine.yaml" in line)
    return yaml.safe_load("\n".join(lines[first + 1 : last]))


@pytest.fixture
def said(recordings, checked) -> Callable[[str], list[str]]:
    """The lines of the check of a recording, which is made once. Nothing is written beside the files of a dataset."""

    def lines(name: str) -> list[str]:
        if name not in SAID:
            before = set((recordings / name).rglob("*"))
            SAID[name] = checked(recordings / name)
            added = {path.name for path in set((recordings / name).rglob("*")) - before}
            assert added == ({"check.png"} if name == "drive" else set())
            picture = next(line for line in SAID[name] if line.startswith("picture: "))
            assert Path(picture.removeprefix("picture: ").partition(": ")[0]).is_file()
        return SAID[name]

    return lines


SAID: dict[str, list[str]] = {}


@pytest.mark.parametrize("name", PRESENT)
def test_every_format_is_recognised_and_its_settings_are_planned(name, recordings, said, workflow):
    format_name, scene, camera, lidar = PRESENT[name]
    lines = said(name)
    assert lines[0].startswith(f"format: {format_name}, by {recordings / name}")
    holds, methods = section(lines, "holds:"), section(lines, "methods: vanilla, street")
    assert any(line.startswith(f"camera {camera}: ") for line in holds)
    assert any(line.startswith(f"LiDAR {lidar}: ") for line in holds)
    assert any(line.startswith("boxes: ") for line in holds) and "moving objects: 1 " in methods[1]
    assert any(line.startswith("metrics of vanilla, street, with ") for line in section(lines, "costs:"))
    settings = proposed(lines)
    assert scene in load(settings).scenes
    if name in ("tables", "ncore"):
        workflow.write_config(yaml.safe_dump(settings))
        planned = workflow.dry_run(f"results/{scene}/metrics.json", "films")
        assert "extract" in planned and "evaluate" in planned


def test_methods_that_render_lidar_need_known_rays(said):
    """The clip's rays have no rows; all others know theirs."""
    for name, fit in (("tables", True), ("waymo_v2", True), ("drive", True), ("ncore", False)):
        (verdict,) = (line for line in section(said(name), "methods: ") if "street_lidar" in line)
        assert ("renders LiDAR" in verdict) == fit
        assert ("not on this recording: LiDAR top: its returns" in verdict) != fit


def test_people_blur_unless_the_preset_represents_them(said):
    by_method = {line.partition(" ")[0]: line for line in section(said("tables"), "methods: ")}
    assert list(by_method) == ["vanilla", "street", "street_people", "street_lidar", "street_discovered", "drifting",
        "people_discovered",
    ]  # fmt: skip
    assert "these blur: 1 pedestrian" in by_method["street"] and "blur" not in by_method["street_people"]


def without(tmp_path: Path, recordings: Path, **changes: Any) -> Path:
    """A drive folder with other keys."""
    folder = tmp_path / "tuesday"
    folder.mkdir()
    record = json.loads((recordings / "drive/monday/drive.json").read_text())
    (folder / "drive.json").write_text(json.dumps(record | changes))
    for part in (recordings / "drive/monday").iterdir():
        if part.is_dir():
            (folder / part.name).symlink_to(part)
    return folder


LACKING = {
    "boxes": ({"tracks": []}, "boxes: no figures", "methods: vanilla, street_discovered (the drive has no boxes"),
    "LiDAR": ({"sweeps": [], "lidars": {}}, "LiDAR: seed points are triangulated", "methods: vanilla, street"),
    "images": ({"frames": [], "cameras": {}, "key_frames": None}, "", "methods: street_lidar"),
    "boxes and LiDAR": (
        {"tracks": [], "sweeps": [], "lidars": {}}, "boxes: no figures", "methods: vanilla, drifting (the drive has",
    ),
}  # fmt: skip


@pytest.mark.parametrize("lacking", LACKING)
def test_what_is_lacking_is_said_and_the_settings_are_planned(lacking, recordings, checked, workflow, tmp_path):
    changes, words, methods = LACKING[lacking]
    lines = checked(without(tmp_path, recordings, **changes))
    assert any(line.startswith(methods) for line in lines), lines
    assert any(line.startswith(words) for line in section(lines, "lacks:")) if words else "no images" in str(lines)
    load(proposed(lines))
    if lacking == "images":
        workflow.write_config(yaml.safe_dump(proposed(lines)))
        workflow.dry_run("results/tuesday/metrics.json")


def test_missing_files_of_a_dataset_are_left_out_by_the_settings(recordings, checked, tmp_path):
    root = drives.write_world(tmp_path / "tables", WORLD)
    for number, folder in enumerate(("CAM_FRONT", "LIDAR_TOP")):
        sorted((root / "samples" / folder).iterdir())[number].unlink()
    lines = checked(root)
    lacks = section(lines, "lacks:")
    assert any(line.startswith("images: frame ") and "is missing" in line for line in lacks)
    assert any(line.startswith("1 sweep: key frame 1") for line in lacks)
    assert section(lines, "holds:")[0].startswith("6 key frames at 2 Hz, 10 images of 1 camera, 10 LiDAR sweeps")
    settings = proposed(lines)
    assert settings["extract"] == settings["lidar_seed"] == {"on_missing": "warn"}


def test_a_config_file_is_checked_with_its_own_methods(recordings, checked, tmp_path):
    config = {
        "datasets": {"own": {"reader": "drive", "dataroot": str(recordings / "drive"), "scenes": ["monday"]}},
        "methods": {"street": None, "people": {"of": "street", "parts": ["background", "deformable"]}},
    }
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(config))
    lines = checked(tmp_path / "mine.yaml")
    assert f"by the dataset own of {tmp_path / 'mine.yaml'}" in lines[0]
    verdicts = section(lines, "methods: vanilla, people")
    assert verdicts[0].startswith("vanilla (of the config file)") and lines[-1].startswith("settings: those of the")
    config |= {"cameras": ["REAR"], "eval_camera": "REAR"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(config))
    lines = checked(tmp_path / "mine.yaml", status=1)
    assert section(lines, "methods: ")[0] == (
        "vanilla (of the config file): not on this recording: the drive has no camera 'REAR'"
    )
    assert lines[-1] == "no method can be trained on scene monday"


def test_costs_are_those_measured_here(recordings, checked, tmp_path):
    """A training and an extraction of another scene of the dataset took 200 s each."""
    dataset = {"reader": "drive", "dataroot": str(recordings / "drive"), "scenes": ["monday", "tuesday"]}
    config = {"datasets": {"own": dataset}, "methods": {"vanilla": None}, "cameras": ["CAM_FRONT"]}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(config))
    assert "by other machines: no such job has run here before" in section(checked(tmp_path / "mine.yaml"), "costs:")[0]
    for job in ("extract", "street/evaluate"):
        path = tmp_path / "results" / BENCHMARKS / "tuesday" / f"{job}.tsv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("s\th:m:s\tmax_rss\tcpu_time\tmean_load\n200.0\t0:03:20\t100\t200\t100\n")
    costs = section(checked(tmp_path / "mine.yaml"), "costs:")
    assert "about 7 min on" in costs[0] and "from 2 measured jobs" in costs[0], costs


def test_images_are_narrower_where_they_exceed_the_memory(checked, tmp_path, monkeypatch):
    root = drives.write_world(tmp_path / "wide", drives.World(key_frames=3, width=1300, height=60))
    assert "images" not in proposed(checked(root))
    monkeypatch.setattr(command, "memory_gb", lambda: 1e-4)
    assert proposed(checked(root))["images"] == {"width": 640}


NO_DRIVES = {
    "empty": (lambda root: root, "is no recording that can be read: looked for nuScenes tables"),
    "absent": (lambda root: root / "none", "there is no "),
    "a text": (lambda root: root / "notes.txt", "is no recording that can be read"),
    "a bag": (lambda root: TestBag.recorded(seconds=0.1).write(root), "is a bag of ROS; `drivesplat import bag"),
}


@pytest.mark.parametrize("what", NO_DRIVES)
def test_what_is_no_drive_is_one_sentence(what, checked, tmp_path):
    place, words = NO_DRIVES[what]
    root = tmp_path / "here"
    root.mkdir()
    (root / "notes.txt").write_text("hello")
    lines = checked(place(root), status=1)
    assert len(lines) == 1 and words in lines[0] and lines[0].startswith("drivesplat: ")


def test_a_folder_of_several_formats_and_an_unknown_scene_are_refused(recordings, checked, tmp_path):
    both = tmp_path / "both"
    both.mkdir()
    (both / "drive.json").symlink_to(recordings / "drive/monday/drive.json")
    (both / "tables").symlink_to(recordings / "tables/v1.0-mini")
    (said,) = checked(both, status=1)
    assert "holds several formats: nuScenes tables" in said and "drive folder" in said
    (said,) = checked(recordings / "tables", "--scene", "0007", status=1)
    assert "there is no scene '0007'" in said and "there are: 0001" in said
