"""The memory that reading a segment takes does not grow with its length."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.drives import World, write_world
from helpers.waymo_drive import NAME, ImageRecording, tiny_drive
from helpers.waymo_files import write_v1, write_v2

IMAGES, MEGABYTES = 400, 1
READ = """
import resource, sys
from pathlib import Path
from drivesplat.readers.waymo.reader import read
from drivesplat.readers.waymo.unpack import unpack
from drivesplat.settings.extract import SceneSource
root, folder = Path(sys.argv[1]), Path(sys.argv[2])
source = SceneSource(dataset="d", reader="waymo", version="", scene=sys.argv[3], frames=None, cameras=("FRONT",),
                     sweeps=False, on_missing="stop")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
scene = unpack(read(root, source), root, source, folder)
print(len(scene.frames), (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


@pytest.mark.slow
@pytest.mark.parametrize("write", [write_v2, write_v1])
def test_a_long_segment_is_read_in_little_memory(write, tmp_path):
    """400 MB of images, in v2 as one row group: less than 150 MB."""
    world = World(key_frames=2, width=48, height=27)
    drive, _ = tiny_drive(write_world(tmp_path / "tables", world), world, lasers=(2,))
    first, random = drive.images[0], np.random.default_rng(0)
    times = [first.frame + 100_000 * i for i in range(IMAGES)]
    images = [
        ImageRecording(time, 1, first.pose, time * 1e-6 + 0.05, random.bytes(MEGABYTES * 2**20)) for time in times
    ]
    frames = dict.fromkeys(times, drive.frames[first.frame])
    long = replace(drive, frames=frames, images=images, sweeps=[], boxes=[])
    root = (
        write_v2(tmp_path / "data", long, rows_per_group=10**6) if write is write_v2 else write(tmp_path / "data", long)
    )
    del images, long
    done = subprocess.run(
        [sys.executable, "-c", READ, str(root), str(tmp_path / "out"), NAME],
        cwd=REPOSITORY, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    count, megabytes = map(int, done.stdout.split())
    assert count == IMAGES == len(list(Path(tmp_path / "out/images/FRONT").iterdir()))
    assert megabytes < 150
