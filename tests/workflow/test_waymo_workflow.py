"""Waymo segments through the whole workflow: the metrics of a drive are near those of its tables."""

import numpy as np
import pytest
from helpers.waymo_drive import GLOBAL, NAME, tables_scan, tiny_drive
from helpers.waymo_files import write_v1, write_v2
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy

from drivesplat.scene.scene import read_scene

pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("waymo_workflow")]
BEGINNING = NAME[:19]
"""Names the segment of v1, so that both are scenes of their own."""
TABLES, V2 = "results/0001/metrics.json", f"results/{NAME}/metrics.json"
V1 = [f"results/{BEGINNING}/{name}" for name in ("seed.ply", "masks/masks.json")]
SEEDS = {f"seed_{seed}": {"overrides": {"random_seed": seed}} for seed in range(3)}
"""A method for each."""


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    front = {"cameras": ["FRONT"], "eval_camera": "FRONT"}
    datasets = {
        "nuscenes": {"dataroot": "data", "scenes": ["0001"]},
        "v2": {"reader": "waymo", "dataroot": "waymo/v2", "scenes": [NAME], "overrides": front},
        "v1": {"reader": "waymo", "dataroot": "waymo/v1", "scenes": [BEGINNING], "overrides": front},
    }
    folder = tmp_path_factory.mktemp("waymo") / "workflow"
    longer = {"train": {**TINY_TRAINING, "iterations": 300}, "lidar_seed": {"max_points": 2000, "far_points": 100}}
    made = WorkflowCopy.make(folder, datasets=datasets, methods=SEEDS, sweeps=False, **longer)
    shifted = GLOBAL.copy()
    shifted[:3, :3] = np.eye(3)  # a turned drive trains otherwise: the faces of its sky lie elsewhere
    drive, _ = tiny_drive(made.folder / "data", scan=tables_scan(), place=shifted)
    write_v2(made.folder / "waymo/v2", drive)
    write_v1(made.folder / "waymo/v1", drive)
    done = made.run(TABLES, V2, *V1)
    assert done.returncode == 0, done.stdout
    return made


def test_metrics_are_near_those_of_the_tables(copy):
    """Mean over three seeds of the training. The LiDAR looks between the rays of the tables' one, so that the seed
    points are others: half a dB is what that makes of a training of 300 iterations."""
    tables, waymo = (copy.read(path) for path in (TABLES, V2))
    assert waymo["protocol"]["poses"] == "waymo"
    figures = [[one["methods"][seed]["interpolation"] for seed in SEEDS] for one in (tables, waymo)]
    mean = [np.mean([one["all"]["psnr"] for one in of_drive]) for of_drive in figures]
    assert mean[1] == pytest.approx(mean[0], abs=0.5)
    pixels = [[one[0][region]["pixels"] for region in ("all", "static", "vehicle")] for one in figures]
    assert pixels[0] == pixels[1]


def test_both_versions_give_the_same_seed_and_masks(copy):
    for name in ("seed.ply", *(f"masks/{kind}/FRONT" for kind in ("sky", "regions"))):
        one, other = (copy.folder / "results" / scene / name for scene in (NAME, BEGINNING))
        files = [(one, other)] if one.is_file() else zip(sorted(one.iterdir()), sorted(other.iterdir()), strict=True)
        contents = [(a.read_bytes(), b.read_bytes()) for a, b in files]
        if name == "seed.ply":  # its header holds the provenance
            contents = [tuple(content.split(b"end_header", 1)[1] for content in pair) for pair in contents]
        assert all(a == b for a, b in contents) and contents


def test_results_are_exact_and_an_altered_recording_is_refused(copy):
    assert copy.planned(V2, *V1) == {}
    scene = read_scene(copy.folder / f"results/{NAME}/scene.json")
    image = copy.folder / scene.frames[0].image_path
    assert image.relative_to(copy.folder / f"results/{NAME}/images/FRONT").suffix == ".jpg"
    whole = image.read_bytes()
    image.write_bytes(whole + b"more")
    (copy.folder / f"results/{NAME}/seed.ply").unlink()
    done = copy.run(f"results/{NAME}/seed.ply")
    assert done.returncode != 0 and "changed since the rule 'extract' read it" in done.stdout, done.stdout
    image.write_bytes(whole)
    done = copy.run(f"results/{NAME}/seed.ply")
    assert done.returncode == 0, done.stdout
