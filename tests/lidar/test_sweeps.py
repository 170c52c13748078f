"""Recordings between key frames (images at 12 Hz, LiDAR at 10 Hz): which are read, which a training may see, and that
none near a held-out key frame reaches an input of the training."""

import dataclasses
import functools
import json
import logging
import pickle
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers.drives import LIDAR_AT, START_US, World, scene_at, seconds_of, write_world
from helpers.small_runs import S, settings_of
from PIL import Image

from drivesplat.errors import DatasetError
from drivesplat.preprocess.actor_seed import actors_record
from drivesplat.preprocess.ego_mask import ego_mask_record
from drivesplat.preprocess.lidar_depth import lidar_depths
from drivesplat.preprocess.lidar_seed import seed_points
from drivesplat.preprocess.masks import make_masks
from drivesplat.preprocess.parser import training_record
from drivesplat.scene.masks import read_sky_mask
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import frame_groups, sweep_groups
from drivesplat.settings.actor_seed import ActorSeedJob
from drivesplat.settings.config import Config, load
from drivesplat.settings.images import HoldoutSettings, ParserJob
from drivesplat.settings.lidar_depth import LidarDepthJob
from drivesplat.settings.lidar_seed import SeedJob
from drivesplat.settings.masks import EgoMaskJob, MaskJob

HALF_AN_INTERVAL = 250_000
WORLD = World(key_frames=8, sweeps_between=5, lidar_between=4)
IMAGES, SWEEPS = 7 * 6 + 1, 7 * 5 + 1
EVERYTHING = {"lidar_sweeps": True}


@pytest.fixture(scope="module")
def rich_root(tmp_path_factory) -> Path:
    """A tiny drive with images and LiDAR sweeps between key frames, read only."""
    return write_world(tmp_path_factory.mktemp("rich"), WORLD)


@pytest.fixture
def root(rich_root, tmp_path) -> Path:
    """A copy of it that a test may damage."""
    return Path(shutil.copytree(rich_root, tmp_path / "nuscenes"))


def table(root: Path, name: str) -> list[dict]:
    return json.loads((root / "v1.0-mini" / f"{name}.json").read_text())


@pytest.mark.parametrize("frames", [None, (2, 6)])
@pytest.mark.parametrize("sweeps", [False, True])
@pytest.mark.parametrize("lidar_sweeps", [False, True])
def test_images_and_lidar_between_key_frames_are_read_on_request(rich_root, frames, sweeps, lidar_sweeps):
    scene = scene_at(rich_root, sweeps, lidar_sweeps=lidar_sweeps, frames=frames)
    first, last = frames or (0, 8)
    intervals = last - first - 1
    assert len(scene.frames) == intervals * (6 if sweeps else 1) + 1
    assert len(scene.sweeps) == intervals * (5 if lidar_sweeps else 1) + 1
    times = np.array([sweep.timestamp for sweep in scene.sweeps])
    assert times[0] == START_US + 500_000 * first and times[-1] == START_US + 500_000 * (last - 1)
    assert set(np.diff(times)) == {100_000 if lidar_sweeps else 500_000}
    for sweep in scene.sweeps:
        expected = WORLD.ego_at(seconds_of(sweep.timestamp) - 0.5 * first) + LIDAR_AT
        np.testing.assert_allclose(sweep.sensor_to_world[:3, 3], expected, atol=1e-6)
        assert sweep.is_key_frame == ((sweep.timestamp - START_US) % 500_000 == 0) == ("samples" in sweep.path)


BOTH_KINDS, IN_A_RANGE = "between and at the end", "in a range"
HOLDOUTS = {
    BOTH_KINDS: ({"every_nth": 4, "offset": 2, "last_block": 2}, None, {2, 6, 7}),
    "the first frame": ({"every_nth": 3, "offset": 0, "last_block": 0}, None, {0, 3, 6}),
    "the last frame alone": ({"every_nth": 0, "last_block": 1}, None, {7}),
    IN_A_RANGE: ({"every_nth": 3, "offset": 1, "last_block": 1}, (2, 8), {3, 6, 7}),
    "at a range's first frame": ({"every_nth": 4, "offset": 0, "last_block": 0}, (3, 7), {3}),
}
"""The hold-out, the range of key frames that is read, and the key frames of the dataset held out then."""
BY_DEFAULT = {BOTH_KINDS, IN_A_RANGE}
"""Those that `make test` tries; tests/scene/test_splits.py has the groups of all kinds."""


@pytest.fixture(scope="module")
def whole(rich_root, tmp_path_factory) -> Callable[[str], dict[str, bytes]]:
    """By the name of a hold-out: all inputs of a training on the undamaged drive."""

    @functools.cache
    def inputs(name: str) -> dict[str, bytes]:
        holdout, frames, _ = HOLDOUTS[name]
        return made(scene_at(rich_root, frames=frames, **EVERYTHING), holdout, tmp_path_factory.mktemp("whole"))

    return inputs


@pytest.fixture(
    params=[name if name in BY_DEFAULT else pytest.param(name, marks=pytest.mark.slow) for name in HOLDOUTS]
)
def case(request, root, whole) -> tuple[Path, dict, tuple[int, int] | None, set[str], dict[str, bytes]]:
    """A drive, a hold-out, a range, the held-out and excluded files, determined from the tables alone, and the inputs
    of a training before any file is damaged."""
    holdout, frames, key_frames = HOLDOUTS[request.param]
    samples = sorted(table(root, "sample"), key=lambda sample: sample["timestamp"])
    near = set()
    for data in table(root, "sample_data"):
        for sample in (samples[i] for i in key_frames):
            own = data["is_key_frame"] and data["sample_token"] == sample["token"]
            if own or (not data["is_key_frame"] and abs(data["timestamp"] - sample["timestamp"]) < HALF_AN_INTERVAL):
                near.add(str(root / data["filename"]))
    return root, holdout, frames, near, whole(request.param)


def spoil(path: str, random: np.random.Generator) -> None:
    """Makes an image magenta, a sweep garbage."""
    if path.endswith(".jpg"):
        Image.new("RGB", (WORLD.width, WORLD.height), (255, 0, 255)).save(path)
    else:
        random.uniform(-25.0, 25.0, (4000, 5)).astype(np.float32).tofile(path)


def config_of(holdout: dict) -> Config:
    """A config without thinning of LiDAR points."""
    all_points = {"lidar_seed": {"far_points": 200, "voxel_size": 0.0}, "actors": {"min_points": 0}}
    return load({"datasets": {"nuscenes": {"scenes": ["0001"]}}, "holdout": holdout, **all_points})


def made(scene: Scene, holdout: dict, folder: Path) -> dict[str, bytes]:
    """All inputs of a training of the scene, each as bytes."""
    config = config_of(holdout)

    def job(stage: str, kind: type[S]) -> S:
        return settings_of(config, stage, kind)

    groups = frame_groups(scene, HoldoutSettings(**holdout))
    training = [frame for frame, group in zip(scene.frames, groups, strict=True) if group == "train"]
    seed = seed_points(scene, job("lidar_seed", SeedJob))
    parser = training_record(scene, seed, job("parser", ParserJob))
    make_masks(scene, job("masks", MaskJob), folder)
    found = {
        "seed": seed,
        "actors": actors_record(scene, job("actors", ActorSeedJob)),
        "lidar_depth": lidar_depths(scene, job("lidar_depth", LidarDepthJob)),
        "own_car": ego_mask_record(scene, job("own_car", EgoMaskJob)),
        "sky": [read_sky_mask(folder, f.camera, f.timestamp, (f.width, f.height)) for f in training],
        "images": [Path(parser.image_paths[i]).read_bytes() for i in parser.splits["train"]],
    }
    return {name: pickle.dumps(value) for name, value in found.items()}


def test_nothing_near_a_held_out_key_frame_reaches_a_training(case, tmp_path):
    root, holdout, frames, near, before = case
    random = np.random.default_rng(0)
    assert {Path(path).parent.parent.name for path in near} == {"samples", "sweeps"}
    for path in near:
        spoil(path, random)
    after = made(scene_at(root, frames=frames, **EVERYTHING), holdout, tmp_path / "after")
    assert {name for name in before if before[name] != after[name]} == set()


@pytest.mark.parametrize("case", [pytest.param(BOTH_KINDS, marks=pytest.mark.slow), IN_A_RANGE], indirect=True)
def test_recordings_just_beyond_the_excluded_ones_reach_a_training(case, tmp_path):
    """Each kind of recording next to the held-out and excluded ones reaches the expected inputs."""
    root, holdout, frames, near, before = case
    scene = scene_at(root, frames=frames, **EVERYTHING)
    images, sweeps = [f.image_path for f in scene.frames], [s.path for s in scene.sweeps]
    random = np.random.default_rng(0)
    for paths, reached in ((sweeps, {"seed", "lidar_depth", "sky"}), (images, {"seed", "images"})):
        beside = {
            path for other, path in [*pairwise(paths), *pairwise(reversed(paths))] if other in near and path not in near
        }
        assert beside and all("sweeps" in path for path in beside)
        for path in beside:
            spoil(path, random)
        after = made(scene_at(root, frames=frames, **EVERYTHING), holdout, tmp_path / "after")
        assert {name for name in before if before[name] != after[name]} >= reached
        before = after


def test_unevenly_spaced_key_frames_exclude_by_time(rich_root):
    """nuScenes' key frames are 400 to 600 ms apart; half the median interval applies on both sides."""
    scene = scene_at(rich_root, **EVERYTHING)
    offsets = np.array([0, 30_000, -50_000, 0, 50_000, -40_000, 20_000, 0])
    uneven = dataclasses.replace(scene, key_frame_timestamps=scene.key_frame_timestamps + offsets)
    holdout = HoldoutSettings(every_nth=3, offset=1, last_block=1)
    held_out = uneven.key_frame_timestamps[[1, 4, 7]]
    half = np.median(np.diff(uneven.key_frame_timestamps)) / 2
    for records, groups in (
        (uneven.frames, frame_groups(uneven, holdout)), (uneven.sweeps, sweep_groups(uneven, holdout))
    ):  # fmt: skip
        between = [(r, g) for r, g in zip(records, groups, strict=True) if not r.is_key_frame]
        nearest = np.array([np.abs(held_out - record.timestamp).min() for record, _ in between])
        assert [group for _, group in between] == ["excluded" if away < half else "train" for away in nearest]
        assert {group for _, group in between} == {"excluded", "train"}


def delete(root: Path, channel: str, count: int) -> list[Path]:
    """Deletes the first `count` recordings of a channel between key frames."""
    paths = sorted((root / "sweeps" / channel).iterdir())[:count]
    for path in paths:
        path.unlink()
    return paths


def test_a_missing_image_between_key_frames_stops_and_names_the_setting_to_skip_it(root):
    (path,) = delete(root, "CAM_FRONT", 1)
    with pytest.raises(DatasetError) as failure:
        scene_at(root)
    for part in ("between key frames", "0001 CAM_FRONT 1 ", str(path), "sweeps: false", "extract.on_missing: warn"):
        assert part in str(failure.value)
    assert len(scene_at(root, sweeps=False).frames) == 8


@pytest.mark.parametrize("count", [3, 35])
def test_missing_images_between_key_frames_are_skipped_and_counted_with_on_missing_warn(root, count, caplog):
    """At most ten names are listed, even if the whole folder sweeps/ is missing."""
    paths = delete(root, "CAM_FRONT", count)
    with caplog.at_level(logging.WARNING, logger="drivesplat.preprocess.extract"):
        scene = scene_at(root, on_missing="warn")
    assert (scene.missing_images, len(scene.frames)) == (count, IMAGES - count)
    messages = [record.getMessage() for record in caplog.records if "left out" in record.getMessage()]
    assert len(messages) == (3 if count == 3 else 11) and str(paths[0]) in messages[0]
    assert count == 3 or f"{count - 10} more of {IMAGES} images" in messages[-1]
