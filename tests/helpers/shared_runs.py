"""What takes long to make and is read by many tests: made once, also for several of pytest's workers."""

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy

VANILLA = {"vanilla": {}}
TWO_METHODS = {**VANILLA, "street": {"parts": ["background", "actors"]}}
CAR = "0001 instance 0"
"""The one vehicle that moves in the tiny world, 8 m ahead of the camera's car."""
STREET = {"sky": "none", "train": {"strategy": "default", "depth_weight": 0.01}}
EDITS = """\
edits:
  gone:
    - remove: {track: 0001 instance 0}
  stop:
    - shift: {track: 0001 instance 0, lateral: 1.0}
    - stop: {track: 0001 instance 0, at: 2}
"""


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """The folder `name` that `make` fills, for all workers of this session; read only. Others wait meanwhile."""
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    folder, made = root / "shared" / name, root / "shared" / f"{name}.made"
    made.parent.mkdir(exist_ok=True)
    with open(made.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            made.touch()
    return folder


def two_edits(folder: Path) -> WorkflowCopy:
    """A workflow of one scene with two methods and two edits."""
    copy = WorkflowCopy.make(
        folder,
        datasets={"nuscenes": {"dataroot": "data", "scenes": ["0001"], "edits": {"0001": "edits.yaml"}}},
        methods={**VANILLA, "street": {**TWO_METHODS["street"], "overrides": STREET}},
        actors={"random_points": 200},
        train={**TINY_TRAINING, "iterations": 20},
    )
    (copy.folder / "edits.yaml").write_text(EDITS)
    return copy


def finished_run(factory: pytest.TempPathFactory) -> WorkflowCopy:
    """The same, run to its end, with the scans of its LiDAR. A test that changes anything takes a copy (`again`)."""

    def run(folder: Path) -> None:
        done = two_edits(folder).run("all", "results/0001/scans.npz")
        assert done.returncode == 0, done.stdout

    folder = made_once(factory, "finished", run)
    return WorkflowCopy(folder, yaml.safe_load((folder / "mine.yaml").read_text()))
