"""Seed points, actors and planning, against bounds in seconds that are meant for two idle cores."""

import dataclasses
import time

import numpy as np
import yaml
from helpers import REPOSITORY
from helpers.drives import World, write_world
from helpers.workflow_copy import WorkflowCopy
from PIL import Image

from drivesplat.lidar.coloring import ColorView, color_by_visibility
from drivesplat.lidar.sweeps import thin
from drivesplat.preprocess.actor_seed import actors_record
from drivesplat.preprocess.extract import extract_scene
from drivesplat.scene.ego_mask import NO_EGO_MASK
from drivesplat.scene.rigid import rigid
from drivesplat.settings.actor_seed import ActorSeedJob
from drivesplat.settings.extract import SceneSource

WIDTH, HEIGHT = 640, 360
SEEDS_S, ACTORS_S, PLANNING_S = 30.0, 10.0, 3.0


def test_1_4_million_points_are_thinned_and_coloured_over_30_views():
    random = np.random.default_rng(0)
    points = random.uniform([-60.0, -3.0, 0.0], [60.0, 3.0, 150.0], (1_400_000, 3))
    intrinsics = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 180.0], [0.0, 0.0, 1.0]])
    usable = np.ones((HEIGHT, WIDTH), dtype=bool)
    views = [
        ColorView(np.full((HEIGHT, WIDTH, 3), i, np.uint8), intrinsics, rigid(np.eye(3), [0, 0, -3.0 * i]), i, usable)
        for i in range(30)
    ]
    began = time.perf_counter()
    kept = points[thin(points, 0.1)]
    _, seen = color_by_visibility(kept, np.zeros(len(kept)), views)
    assert time.perf_counter() - began < SEEDS_S
    assert len(kept) > 1_000_000 and seen.any()


def test_20_actors_in_40_images_are_gathered_and_coloured(tmp_path):
    source = SceneSource(
        dataset="tiny", reader="nuscenes", version="v1.0-mini", scene="0001", frames=None, cameras=("CAM_FRONT",),
        sweeps=True, on_missing="stop",
    )  # fmt: skip
    scene = extract_scene(source, write_world(tmp_path / "tiny", World()))
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.jpg")
    large = {"image_path": str(tmp_path / "noise.jpg"), "width": WIDTH, "height": HEIGHT}
    scaled = np.diag([WIDTH / 96, WIDTH / 96, 1.0])
    frames = tuple(
        dataclasses.replace(frame, **large, intrinsics=scaled @ frame.intrinsics)
        for frame in (scene.frames[i % 18] for i in range(40))
    )
    car = next(track for track in scene.tracks if track.category == "vehicle.car")
    shifts = [
        np.array([[0, 0, 0, 3.0 * (i // 5)], [0, 0, 0, 3.0 * (i % 5) - 6.0], [0] * 4, [0] * 4]) for i in range(20)
    ]
    tracks = tuple(
        dataclasses.replace(car, id=str(i), object_to_world=car.object_to_world + shift)
        for i, shift in enumerate(shifts)
    )
    scene = dataclasses.replace(scene, frames=frames, tracks=tracks)
    job = ActorSeedJob.model_validate({
        "actors": {"min_points": 10**6, "random_points": 20_000}, "holdout": {"every_nth": 0, "last_block": 0},
        "images": {"width": None}, "own_car_radius": 2.5, "random_seed": 0,
    })  # fmt: skip
    began = time.perf_counter()
    found = actors_record(scene, job, NO_EGO_MASK).actors
    assert time.perf_counter() - began < ACTORS_S
    assert len(found) >= 5 and all(len(actor.points) == 20_000 for actor in found)


def test_ten_drives_of_two_methods_each_are_planned(tmp_path):
    copy = WorkflowCopy.make(tmp_path / "workflow")
    preset = yaml.safe_load((REPOSITORY / "presets/demo_batch.yaml").read_text())
    copy.config = {**preset, "lpips": {"enabled": False}, "device": "cpu"}
    copy.write_config()
    copy.planned("all")
    began = time.perf_counter()
    planned = copy.planned("all")
    assert time.perf_counter() - began < PLANNING_S
    assert planned["extract"] == 10 and planned["train"] == 20
