"""Shape checks switched on for the whole library, and the tiny world."""

import os
from itertools import groupby
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch comes: its threads times pytest's workers is slow
# Copies of the workflow run the same kernels as the tests themselves: those that the set-up compiled.
os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(__file__).parents[1] / "drivesplat/__pycache__"))

import hypothesis
import pytest
import torch
from helpers.checked_types import begin_test, check_types_of

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")  # asked for before Triton comes: its own library is kernels, too

check_types_of("drivesplat")

# The same examples in every run; no test measures time, and fixtures are read only or renewed by the test itself.
hypothesis.settings.register_profile(
    "repeatable", derandomize=True, deadline=None, database=None, suppress_health_check=list(hypothesis.HealthCheck)
)
hypothesis.settings.load_profile("repeatable")

REPOSITORY = Path(__file__).parent.parent


@pytest.hookimpl(trylast=True)  # when it is known which tests are left out: workers' shares are cut by their number
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Has each of pytest's workers, who begin with equal shares, start with what runs Snakemake, the largest modules
    first: they take long and make what their tests share. What one worker takes from another at the end is then short.
    """
    runs = [item for item in items if item.get_closest_marker("workflow")]
    others = [item for item in items if not item.get_closest_marker("workflow")]
    modules = sorted((list(module) for _, module in groupby(runs, key=lambda item: item.path)), key=len, reverse=True)
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    shares = [[item for module in modules[i::workers] for item in module] for i in range(workers)]
    for i, share in enumerate(shares):
        room = max(0, len(items) * (i + 1) // workers - len(items) * i // workers - len(share))
        # the first worker makes the finished run; others come to it at their end, and need not wait for it
        late = [item for item in share if i and "finished_run" in getattr(item, "fixturenames", ())]
        share[:] = [*(item for item in share if item not in late), *others[:room], *late]
        others = others[room:]
    items[:] = [item for share in shares for item in share] + others


def pytest_runtest_setup() -> None:
    begin_test()


@pytest.fixture(scope="module")
def one_thread():
    """Tests run side by side: with a thread per core each, they would mostly wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def tiny_root(tmp_path_factory) -> Path:
    """A tiny drive in nuScenes format: scene 0001, read only."""
    from helpers.drives import World, write_world

    return write_world(tmp_path_factory.mktemp("tiny"), World())


@pytest.fixture(scope="module")
def uncompared():
    """Extractions and checks do not compare recordings with each other."""
    from helpers.drives import uncompared

    with uncompared():
        yield


@pytest.fixture(scope="session")
def small_root(tmp_path_factory) -> Path:
    """A tiny drive of three key frames with smaller images, read only."""
    from helpers.drives import SMALL, write_world

    return write_world(tmp_path_factory.mktemp("small"), SMALL)


@pytest.fixture(scope="session")
def tiny_scene(tiny_root):
    """The tiny drive as a Scene, with the images between key frames."""
    from helpers.drives import scene_at

    return scene_at(tiny_root)


@pytest.fixture(scope="session")
def real_scene_root() -> Path:
    """The folder of a real nuScenes scene-0061; skips where there is none."""
    root = Path(os.environ.get("NUSCENES_SCENE0061", REPOSITORY.parent / "shared/data/nuscenes-scene0061"))
    if not (root / "v1.0-mini").is_dir():
        pytest.skip(f"no real nuScenes scene at {root}: set NUSCENES_SCENE0061 to one")
    return root


@pytest.fixture(scope="session")
def demo_job():
    """The settings of a small synthetic drive by day."""
    from helpers.demo_worlds import CAMERAS, job_of, world_of

    return job_of(world_of(width=160, key_frames=6, cameras=CAMERAS, sweeps=("CAM_FRONT",)))


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory):
    """The workflow run to its end on the tiny drive, with two methods and two edits: read only."""
    from helpers.shared_runs import finished_run

    return finished_run(tmp_path_factory)


@pytest.fixture(scope="session")
def demo_root(demo_job, tmp_path_factory) -> Path:
    """A small synthetic drive in nuScenes format with its truth: scene demo, read only."""
    from helpers.shared_runs import made_once

    from drivesplat.world.generate import make_world

    return made_once(tmp_path_factory, "demo", lambda root: make_world(root, demo_job, {"stages": {}}, workers=2))


@pytest.fixture(scope="session")
def demo_recorder(demo_job):
    """What recorded it."""
    from drivesplat.world.recorder import Recorder

    return Recorder(demo_job.world)


@pytest.fixture(scope="session")
def demo_tables(demo_root):
    """It as nuscenes-devkit reads it."""
    from nuscenes.nuscenes import NuScenes

    return NuScenes("v1.0-mini", str(demo_root), verbose=False)
