"""Trainings of next to nothing, and what they are trained on."""

import dataclasses
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.actors import Actors
from drivesplat.model.background import Background
from drivesplat.model.deformable import Deformable
from drivesplat.model.drifting import Drifting, DriftingSeed
from drivesplat.model.height_field import HeightField
from drivesplat.model.road import EDGE, RoadPart, RoadSeed
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import ActorTrack
from drivesplat.model.view import View
from drivesplat.scene.masks import mask_name
from drivesplat.scene.regions import LABELS
from drivesplat.scene.scan import Scan, ScanRays
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import (
    DefaultSettings,
    FloaterSettings,
    GaussianSettings,
    McmcSettings,
    PartName,
    SkyKind,
    TrainJob,
    TrainSettings,
)
from drivesplat.training.loop import TrainingFolders, TrainingSummary, train
from drivesplat.training.stage import TrainingFiles, TrainingInputs
from drivesplat.training.views import LidarDepth, TrainingView
from helpers import REPOSITORY
from helpers.hand_made import actor_record, actors_of, motion_through, track_of
from helpers.records import recorded_scan, training_record_of
from helpers.reference_rasterizer import rasterize_reference

CPU = torch.device("cpu")
WIDTH, HEIGHT = 32, 24
WALL_AT = 6.0
ITERATIONS, CHECKPOINT_AT, ENDED_AT = 60, 30, 43


def recorded_views(count: int = 5, width: int = WIDTH, height: int = HEIGHT, device: torch.device = CPU) -> list:
    """What `count` cameras in a row see of a cloud of random Gaussians."""
    rng = np.random.default_rng(0)
    n = 80
    cloud = [
        rng.uniform([-3, -1.5, 3], [3, 1.5, 6], (n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.1, 0.5, (n, 3)),
        rng.uniform(0.3, 1.0, n), rng.uniform(0, 1, (n, 3)),
    ]  # fmt: skip
    tensors = [torch.from_numpy(values).float() for values in cloud]
    views = []
    for i in range(count):
        camera_to_world = torch.eye(4)
        camera_to_world[0, 3] = 2.0 * i / max(1, count - 1) - 1.0
        intrinsics = torch.tensor([[0.7 * width, 0.0, width / 2], [0.0, 0.7 * width, height / 2], [0.0, 0.0, 1.0]])
        view = View(intrinsics, camera_to_world, width, height, time=0.5 * i)
        image = rasterize_reference(*tensors, view.viewmat[None], view.K[None], width, height).image[0]
        moved = View(view.K.to(device), camera_to_world.to(device), width, height, view.time)
        views.append(TrainingView(moved, (image.clamp(0, 1) * 255).to(torch.uint8).to(device), None))
    return views


def scan_of_a_wall(x: float = 0.0, intensity: float = 0.3) -> RecordedScan:
    """What a sensor at (x, 0, 0) that looks along z measures of a wall at WALL_AT before the cameras of
    `recorded_views`; the last fifth of the rays is dropped."""
    azimuths, elevations = (
        values.astype(np.float32) for values in np.meshgrid(np.linspace(-0.35, 0.35, 30), np.linspace(-0.2, 0.2, 12))
    )
    ranges = (WALL_AT / (np.cos(elevations) * np.cos(azimuths))).astype(np.float32)
    returned = np.ones(ranges.shape, dtype=bool)
    returned[:, 24:] = False
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]  # the sensor's x is the cameras' z
    pose[0, 3] = x
    values = np.full(ranges.shape, intensity, dtype=np.float32)
    scan = Scan(ScanRays(azimuths, elevations, np.zeros_like(ranges)), returned, ranges * returned, values * returned)
    return recorded_scan(scan, pose)


def seed_points(count: int = 90) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return rng.uniform([-3, -1.5, 3], [3, 1.5, 6], (count, 3)), rng.uniform(0.3, 0.7, (count, 3))


def untrained(
    settings: TrainSettings, sky: bool = False, lidar_logits: tuple[float, float] | None = None, offsets: bool = False
) -> SplatModel:
    part = Background.from_points(*seed_points(), settings.gaussians, 1.0, lidar_logits=lidar_logits, offsets=offsets)
    return SplatModel([part], ConstantSky(torch.full((3,), 0.5), 1e-2) if sky else None)


def cars() -> list[ActorTrack]:
    """Two that cross what the cameras of `recorded_views` see; the second comes when half of them have looked."""
    early, late = 0.5 * np.arange(5), 1.0 + 0.5 * np.arange(3)
    size = (1.6, 0.8, 0.8)
    return [
        track_of(motion_through(early, [[t - 1.5, 0.3, 4.0] for t in early], 0.3 * early), "early", size),
        track_of(motion_through(late, [[2.0 - t, -0.6, 4.5] for t in late], -0.4 * late), "late", size),
    ]


def untrained_street(
    settings: TrainSettings, lidar_logits: tuple[float, float] | None = None, people: bool = False
) -> SplatModel:
    """Background, two cars and a sky; with `lidar_logits` of intensity and returns, for a LiDAR, too, with the offsets
    that settings want. `people`: what the cars are deforms."""
    still = untrained(settings, sky=True, lidar_logits=lidar_logits, offsets=settings.scans.fine_tune > 0)
    own = settings.deformable if people else settings.actors
    moving: Actors = actors_of(*cars(), count=25, settings=own, shaken=False, lidar_logits=lidar_logits)
    if people:
        params = {name: value.detach() for name, value in moving.params.items()}
        moving = Deformable(params, moving.timeline.tracks, settings.deformable, settings.gaussians)
    return SplatModel([*still.parts, moving], still.sky)


def untrained_drifting(settings: TrainSettings) -> SplatModel:
    """Background, drifting Gaussians with velocities and life peaks during the drive of `recorded_views`, and a sky."""
    still, rng, (positions, colors) = untrained(settings, sky=True), np.random.default_rng(2), seed_points(40)
    velocities, peaks, scales = rng.normal(size=positions.shape), rng.uniform(0.0, 2.0, 40), np.full(40, 0.2)
    seed = DriftingSeed(positions, velocities, peaks, colors, scales)
    drifting = Drifting.from_seed(seed, settings.drifting, settings.gaussians, 1.0, (0.0, 2.0))
    return SplatModel([*still.parts, drifting], still.sky)


def untrained_road(settings: TrainSettings) -> SplatModel:
    """Background, a road 4 metres before the cameras of `recorded_views`, whose axes it shares, and a sky."""
    still, (positions, colors) = untrained(settings, sky=True), seed_points(40)
    nodes = int(8.0 / EDGE) + 1
    covered = torch.ones(nodes - 1, nodes - 1, dtype=torch.bool)
    surface = HeightField(torch.full((2,), -4.0), EDGE, torch.full((nodes, nodes), 4.0), covered)
    positions[:, 2] = 4.0
    road = RoadPart.from_seed(RoadSeed(surface, positions, np.full(40, 0.3), colors), settings.gaussians, 1.0)
    return SplatModel([*still.parts, road], still.sky)


def guided_views(device: torch.device = CPU) -> list[TrainingView]:
    """Recorded views with every guide that a training can use."""
    views = []
    for view in recorded_views(device=device):
        rows = torch.arange(HEIGHT, device=device)[:, None].expand(HEIGHT, WIDTH)
        lidar = LidarDepth(torch.arange(200, 400).to(device), torch.linspace(3.0, 6.0, 200).to(device))
        views.append(dataclasses.replace(view, sky=rows < 5, moving=(rows > 8) & (rows < 15), lidar=lidar))
    return views


def without_sky_masks(views: list[TrainingView]) -> list[TrainingView]:
    """The views as of a drive by night: no sky is known, and the lower rows, fewer in each, cannot show it."""
    rows = torch.arange(HEIGHT, device=views[0].pixels.device)[:, None].expand(HEIGHT, WIDTH)
    return [dataclasses.replace(view, sky=None, not_sky=rows > 5 + i) for i, view in enumerate(views)]


ALL_TERMS = {
    "sky_bce_weight": 0.05, "horizon_weight": 0.05, "depth_weight": 0.01, "smoothness_weight": 0.1,
    "entropy_weight": 0.1, "dynamic_weight": 0.1,
}  # fmt: skip


def settings_of(strategy: str = "mcmc", **changes: Any) -> TrainSettings:
    """A training of 60 iterations in which everything happens that happens in one of 30,000."""
    common = {
        "iterations": ITERATIONS, "strategy": strategy, "cap_max": 200, "checkpoint_every": CHECKPOINT_AT,
        "min_checkpoint_interval_s": 0.0, "log_every": 10, "image_every": 30,
        "gaussians": GaussianSettings(sh_degree=1, lr_means=2e-3, lr_sh0=2e-2, lr_scales=1e-2),
        "mcmc": McmcSettings(refine_every=5, noise_lr=1e3),
        "default": DefaultSettings(refine_every=5, grow_grad2d=5e-3),
        "floaters": FloaterSettings(every=7),
    }  # fmt: skip
    return TrainSettings(**{**common, **changes})


def folders_of(folder: Path, fingerprint: str) -> TrainingFolders:
    return TrainingFolders(folder / "resume", folder / "tensorboard", fingerprint, "train")


def trained(
    folder: Path,
    settings: TrainSettings,
    views: list | None = None,
    seed: int = 0,
    device: torch.device = CPU,
    model: SplatModel | None = None,
    fingerprint: str = "of this training",
) -> tuple[SplatModel, TrainingSummary]:
    """The model after `train`, and its summary."""
    model = untrained(settings) if model is None else model
    views = recorded_views(device=device) if views is None else views
    return model, train(model, views, settings, seed, device, folders_of(folder, fingerprint))


@torch.no_grad()
def mean_psnr(model: SplatModel, views: list[TrainingView]) -> float:
    errors = [float((model.render(v.view, 1).image.clamp(0, 1) - v.target()).square().mean()) for v in views]
    return float(np.mean([-10.0 * math.log10(error) for error in errors]))


class EndedError(Exception):
    """Stands for whatever ends a training that could have gone on."""


class EndingViews(list):
    """Training images of which the `at`-th look ends the training."""

    def __init__(self, views: list[TrainingView], at: int, kill: bool = False):
        super().__init__(views)
        self._looks_left, self._kill = at, kill

    def __getitem__(self, index: int) -> TrainingView:
        self._looks_left -= 1
        if self._looks_left < 0 and self._kill:
            os.kill(os.getpid(), signal.SIGKILL)
        if self._looks_left < 0:
            raise EndedError
        return super().__getitem__(index)


def in_subprocess(function: Callable[..., None], *arguments: str) -> subprocess.Popen:
    """A process that calls a function of a test module."""
    module = Path(sys.modules[function.__module__].__file__)
    paths = [str(REPOSITORY), str(REPOSITORY / "tests"), str(module.parent)]
    script = (
        f"import sys; sys.path[:0] = {paths}; import {function.__module__} as m; m.{function.__name__}(*{arguments})"
    )
    return subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def same_parameters(a: SplatModel, b: SplatModel) -> bool:
    first, second = a.state_dict(), b.state_dict()
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def parser_record(folder: Path, views: list[TrainingView]) -> TrainingRecord:
    """What the stage `parser` would say of recorded views; the third is held out."""
    n = len(views)
    paths = [str(folder / f"{i}.png") for i in range(n)]
    folder.mkdir(parents=True, exist_ok=True)
    for path, view in zip(paths, views, strict=True):
        Image.fromarray(view.pixels.numpy()).save(path)
    points, colors = seed_points()
    poses = np.stack([v.view.camera_to_world.double().numpy() for v in views])
    return training_record_of(
        n,
        Ks=np.stack([v.view.K.double().numpy() for v in views]),
        camtoworlds=poses,
        ego_to_world=poses,
        image_paths=paths,
        image_sizes=np.array([[WIDTH, HEIGHT]] * n, dtype=np.int64),
        points=points.astype(np.float32),
        points_rgb=(colors * 255).astype(np.uint8),
        splits={"train": np.array([i for i in range(n) if i != 2]), "interpolation": np.array([2])},
    )


PROVENANCE = {"settings_sha256": "a", "code_sha256": "b", "inputs_sha256": "c", "stages": {}, "inputs": {}}


def job_of(parts: tuple[PartName, ...] = ("background",), sky: SkyKind = "none", **changes: Any) -> TrainJob:
    settings = settings_of(**{"iterations": 20, "checkpoint_every": 10, "pixels_per_gaussian": 0, **changes})
    return TrainJob(parts=parts, sky=sky, train=settings, random_seed=3)


def files_in(folder: Path) -> TrainingFiles:
    return TrainingFiles(folder / "checkpoint.npz", folder / "train.json")


def inputs_in(folder: Path, actors: bool = False) -> TrainingInputs:
    """Recorded views; with `actors` also two cars, the lower half of each image marked as them, and depths."""
    record = parser_record(folder / "images", recorded_views())
    for i, time in enumerate(record.timestamps):
        labels = np.full((HEIGHT, WIDTH), LABELS["static"], np.uint8)
        if actors:
            labels[HEIGHT // 2 :, : WIDTH // 2], labels[HEIGHT // 2 :, WIDTH // 2 :] = LABELS["moving_car"], 8
        for kind, mask in (("regions", labels), ("sky", np.eye(HEIGHT, WIDTH, i, dtype=np.uint8) * 255)):
            path = folder / "masks" / mask_name(kind, "CAM_FRONT", int(time))
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask).save(path)
    if not actors:
        return TrainingInputs(record, folder / "masks", [], [])
    depth = PixelDepths(np.arange(9, dtype=np.int32), np.arange(9, dtype=np.int32), np.full(9, 4.0))
    records = [actor_record(track, 25, seed) for seed, track in enumerate(cars())]
    return TrainingInputs(record, folder / "masks", records, [depth] * 5)
