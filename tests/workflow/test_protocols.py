"""The presets of published protocols: they plan, hold out what their documents say, and repeat published figures."""

from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from helpers import REPOSITORY

from drivesplat.readers.waymo.names import COMPONENTS
from drivesplat.settings.config import for_scene, merged
from drivesplat.workflow.config_files import check_config_files
from drivesplat.workflow.plan import Plan

FILES = {path.stem: path for path in sorted((REPOSITORY / "presets/protocols").glob("*.yaml"))}
WAYMO = ("amd_street_gaussians", "omnire_waymo")
EVERY = pytest.mark.parametrize("name", FILES)


def plan(name: str, **changes: Any) -> Plan:
    """The plan of a preset over the defaults, with `changes` over both."""
    defaults = yaml.safe_load((REPOSITORY / "config.yaml").read_text(encoding="utf-8"))
    preset = yaml.safe_load(FILES[name].read_text(encoding="utf-8"))
    return Plan(merged(merged(defaults, preset), changes), str(REPOSITORY))


def header(name: str) -> str:
    """The comment at the beginning of a preset, on one line."""
    lines = FILES[name].read_text(encoding="utf-8").splitlines()
    end = next(number for number, line in enumerate(lines) if not line.startswith("#"))
    return " ".join(line.removeprefix("#").strip() for line in lines[:end])


@EVERY
def test_a_preset_measures_as_its_header_and_document_say(name):
    """One command measures both methods on every scene and writes the report; iterations, held-out images and cameras
    are those of the document for each; published figures are of measured scenes, or means over a known number."""
    made, text = plan(name), header(name)
    config = made.config
    (dataset,) = [found for found in config.datasets.values() if found.batch]
    metrics = [f"results/protocols/{name}/{scene}/metrics.json" for scene in dataset.scenes]
    assert made.report(["metrics", "report"]).metrics() == metrics and list(config.methods) == ["vanilla", "street"]
    assert f"snakemake --cores 4 --configfile presets/protocols/{name}.yaml -- metrics report" in text
    assert "Held out: " in text and "Data: " in text and "Not run by the authors" in text
    for scene in config.batch_scenes:
        for method in config.methods:
            there = for_scene(config, scene, method)
            assert there.train.iterations == 30_000 and there.holdout.last_block == 0
            assert there.eval_camera == there.cameras[0]
    assert config.published
    for item in config.published:
        assert item.url in text or item.url.replace("https://arxiv.org/abs/", "arXiv ") in text
        assert item.scene in config.batch_scenes or (item.scene == "mean" and item.scenes)
        assert item.group == "interpolation"


@pytest.mark.parametrize(
    ("name", "frames", "held_out"),
    [
        ("omnire_waymo", 200, list(range(10, 200, 10))),
        ("amd_street_gaussians", 198, list(range(10, 198, 10))),
        ("amd_street_gaussians", 90, [10, 20, 30, 40, 50, 60, 70, 80]),
        ("vad_gs_nuscenes", 39, [4, 8, 12, 16, 20, 24, 28, 32, 36]),
    ],
)
def test_held_out_are_the_frames_of_the_document(name, frames, held_out):
    holdout = plan(name).config.holdout
    assert holdout.held_out(frames) == {"interpolation": held_out, "extrapolation": []}


@pytest.mark.parametrize("name", WAYMO)
def test_neighbours_of_held_out_frames_at_10_hz_are_trained_on_and_poses_are_recorded(name):
    config = plan(name).config
    assert config.holdout.neighbourhood_s == 0.0 and config.refine_poses.enabled is False
    assert config.images.width == {"amd_street_gaussians": None, "omnire_waymo": 960}[name]


def test_a_segment_is_measured_whole_and_cut_with_results_of_their_own(tmp_path):
    made = plan("amd_street_gaussians", datasets={"waymo": {"dataroot": str(tmp_path)}})
    whole = [scene for scene in made.config.batch_scenes if "_" in scene]
    for component in COMPONENTS:
        for segment in whole:
            (tmp_path / component).mkdir(exist_ok=True)
            (tmp_path / component / f"{segment}.parquet").touch()
    made.refuse_absent_data(["metrics", "report"])
    assert len(whole) == 4 and len(set(made.report([]).metrics())) == 8
    ranges = []
    for segment in whole:
        short = segment.partition("_")[0]
        tables = [made.tables(SimpleNamespace(scene=scene)) for scene in (segment, short)]
        assert tables[0] != [] and tables[0] == tables[1], "the same files"
        of_scene = [made.config.datasets["waymo"].frames.get(scene) for scene in (segment, short)]
        assert of_scene[0] is None
        ranges.append(of_scene[1])
    assert ranges == [(100, 190), (20, 115), (0, 160), (0, 85)]


def figures(name: str, *keys: str) -> list[tuple[Any, ...]]:
    return [tuple(getattr(item, key) for key in keys) for item in plan(name).config.published]


def test_a_preset_has_no_key_twice():
    """Of which YAML silently keeps the last."""
    check_config_files([str(path) for path in FILES.values()])
