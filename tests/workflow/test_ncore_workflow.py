"""An NCore clip through the whole workflow: seed and metrics are those of the tables of the same drive."""

import numpy as np
import pytest
from helpers import drives
from helpers.ncore_clips import NAME, tables_recording, write_clip
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy
from scipy.spatial import cKDTree

from drivesplat.io.point_cloud import read_positions

pytest.importorskip("ncore")
pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("ncore_workflow")]
TABLES, CLIP = "results/0001", f"results/{NAME}"
SEEDS = {f"seed_{seed}": {"overrides": {"random_seed": seed}} for seed in range(3)}
"""A method for each."""


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    front = {"cameras": ["front"], "eval_camera": "front"}
    datasets = {
        "nuscenes": {"dataroot": "data", "scenes": ["0001"]},
        "clips": {"reader": "ncore", "dataroot": "clips", "scenes": [NAME], "overrides": front},
    }
    folder = tmp_path_factory.mktemp("ncore") / "workflow"
    longer = {"train": {**TINY_TRAINING, "iterations": 300}, "lidar_seed": {"max_points": 50_000, "far_points": 100}}
    made = WorkflowCopy.make(folder, datasets=datasets, methods=SEEDS, sweeps=False, **longer)
    scene = drives.scene_at(drives.write_world(made.folder / "data", drives.World()), sweeps=False)
    write_clip(made.folder / "clips", tables_recording(scene, readout_us=0))
    done = made.run(f"{TABLES}/metrics.json", f"{CLIP}/metrics.json")
    assert done.returncode == 0, done.stdout
    return made


def test_the_seed_is_that_of_the_tables(copy):
    """All points are kept. Distances of single precision move few of them to another voxel: the ground lies exactly
    between two."""
    tables, clip = (read_positions(copy.folder / scene / "seed.ply") for scene in (TABLES, CLIP))
    near, _ = cKDTree(tables).query(clip)
    assert abs(len(tables) - len(clip)) < 0.05 * len(tables) and len(clip) > 3000
    assert np.median(near) < 1e-4 and np.mean(near < 0.01) > 0.95


def test_metrics_are_those_of_the_tables(copy):
    """Mean over three seeds of the training."""
    tables, clip = (copy.read(f"{scene}/metrics.json") for scene in (TABLES, CLIP))
    assert clip["protocol"]["poses"] == "ncore"
    figures = [[one["methods"][seed]["interpolation"] for seed in SEEDS] for one in (tables, clip)]
    static = [np.mean([one["static"]["psnr"] for one in of_drive]) for of_drive in figures]
    assert static[1] == pytest.approx(static[0], abs=0.3)
    pixels = [[one[0][region]["pixels"] for region in ("all", "static", "vehicle")] for one in figures]
    assert pixels[0] == pixels[1]


def test_a_clip_is_planned_again_without_jobs(copy):
    assert copy.planned(f"{CLIP}/metrics.json") == {}
