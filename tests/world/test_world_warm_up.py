"""What the set-up compiles beforehand is what a synthetic world would wait for."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import REPOSITORY

WORLDS = """
import pathlib, sys
from drivesplat.world.warm_up import WORLD, warm_up
from drivesplat.world.generate import make_world
from drivesplat.provenance.record import provenance
from drivesplat.settings.world import WorldJob

root, cache = map(pathlib.Path, sys.argv[1:])
warm_up(root / "tiny")
print(len(list(cache.rglob("*.nbc"))))
larger = WORLD.model_copy(update={"width": 96, "key_frames": 3, "random_seed": 5})
make_world(root / "larger", WorldJob(scene="x", version="v1.0-mini", world=larger), provenance("w", {}, "", [], {}), 2)
print(len(list(cache.rglob("*.nbc"))))
"""


@pytest.mark.slow
def test_the_warm_up_compiles_every_kernel_of_a_world_by_day(tmp_path):
    cache = tmp_path / "cache"
    done = subprocess.run(
        [sys.executable, "-c", WORLDS, str(tmp_path), str(cache)],
        cwd=REPOSITORY, env={**os.environ, "NUMBA_CACHE_DIR": str(cache)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    warmed, afterwards = map(int, done.stdout.split())
    assert warmed == afterwards > 5
    assert Path(tmp_path / "larger/v1.0-mini/scene.json").exists()
