"""Models and recordings small enough that a test can say what comes out of them."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from drivesplat.io.point_cloud import PointCloud
from drivesplat.kernels.spherical_harmonics import SH_C0
from drivesplat.model.actors import Actors
from drivesplat.model.background import Background
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.part import Part
from drivesplat.model.states import IMAGE, State, Want
from drivesplat.model.timeline import ActorTrack
from drivesplat.model.view import View
from drivesplat.preprocess.parser import training_record
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.masks import mask_name
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.images import HoldoutSettings, ImageSettings, ParserJob
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import ActorSettings
from drivesplat.trajectories.actor_record import ActorRecord
from drivesplat.trajectories.motion import Motion

BLACK = (0.0, 0.0, 0.0)


def round_gaussians(places: Any, sizes: Any = 0.1, opacities: Any = 0.95, colors: Any = BLACK) -> Background:
    """Round Gaussians at world `places` (n, 3), their standard deviations `sizes` in metres, of one colour each."""
    means = torch.tensor(np.asarray(places, dtype=float)).reshape(-1, 3).float()
    n = len(means)
    params = {
        "means": means,
        "scales": torch.log(torch.tensor(sizes).expand(n)).float()[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        "opacities": torch.logit(torch.tensor(opacities).expand(n).float()),
        "sh0": ((torch.tensor(colors).expand(n, 3).float() - 0.5) / SH_C0)[:, None, :],
        "shN": torch.zeros(n, 0, 3),
    }
    return Background(params, GaussianSettings(sh_degree=0), 1.0)


class Own(Part):
    """Gaussians that are known as a track's own."""

    name = "own"
    moves = True

    def __init__(self, still: Background, track_id: str):
        super().__init__()
        self.params = still.params
        self._still = still
        self._track_id = track_id

    def sample(self, state: State, want: Want = IMAGE) -> Gaussians:
        return self._still.sample(state, want)

    def learning_rates(self) -> dict[str, float]:
        return self._still.learning_rates()

    def of_track(self, track_id: str) -> torch.Tensor | None:
        return torch.ones(len(self), dtype=torch.bool) if track_id == self._track_id else None


def about_z(angle: float) -> np.ndarray:
    """The rotation (3, 3) by an angle (radians) about z."""
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def motion_through(
    times: Any, places: Any, headings: Any = 0.0, runs: tuple[tuple[int, int], ...] | None = None, reach: float = 0.25
) -> Motion:
    """The motion through world `places` (k, 3) at `times` (k,), seconds, with `headings` about z (radians, one or k);
    a single run where `runs` does not say otherwise."""
    times, places = np.asarray(times, dtype=float), np.asarray(places, dtype=float)
    headings = np.broadcast_to(np.asarray(headings, dtype=float), times.shape)
    poses = np.stack([rigid(about_z(angle), place) for angle, place in zip(headings, places, strict=True)])
    return Motion(times, poses, runs or ((0, len(times) - 1),), reach)


def track_of(motion: Motion, name: str = "it", size: Any = (4.0, 2.0, 1.6)) -> ActorTrack:
    return ActorTrack(name, np.asarray(size, dtype=float), motion)


def actors_of(
    *tracks: ActorTrack, count: int = 6, settings: ActorSettings | None = None, seed: int = 0, shaken: bool = True,
    lidar_logits: tuple[float, float] | None = None,
) -> Actors:  # fmt: skip
    """Actors of `count` Gaussians each within their boxes, with `lidar_logits` for a LiDAR, too. `shaken`: every
    parameter is random, corrections of the tracks (0.1 m, 0.1 rad) and all coefficients of the colours included, as
    after a training."""
    rng = np.random.default_rng(seed)
    points = [rng.uniform(-0.5, 0.5, (count, 3)) * track.size for track in tracks]
    colors = [rng.uniform(0.0, 1.0, (count, 3)) for _ in tracks]
    settings = ActorSettings() if settings is None else settings
    gaussians = GaussianSettings(init_opacity=0.6)
    actors = Actors.from_points(tracks, points, colors, settings, gaussians, lidar_logits=lidar_logits)
    if shaken:
        with torch.no_grad():
            for name, value in (*actors.params.items(), *actors.shared.items()):
                size = {"translation": 0.1, "yaw": 0.1, "quats": 1.0}.get(name, 0.3)
                if value.is_floating_point() and name != "means":
                    value += size * torch.from_numpy(rng.normal(size=value.shape)).float()
    return actors


def actor_record(track: ActorTrack, count: int = 10, seed: int = 0, pixels: int = 1000) -> ActorRecord:
    """What actors.npz would hold of an actor that starts from `count` points in its box, which shows so many pixels."""
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-0.5, 0.5, (count, 3)) * track.size).astype(np.float32)
    colors = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    return ActorRecord(
        id=track.id, category="vehicle.car", size=track.size, motion=track.motion, points=points, points_rgb=colors,
        lidar_points=count, pixels=pixels,
    )  # fmt: skip


def looking_at(target: Any, place: Any, time: float = 0.0, width: int = 48, height: int = 32) -> View:
    """The view of a camera at world `place` that looks at `target` with its right side level."""
    forward = np.asarray(target, dtype=float) - np.asarray(place, dtype=float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = rigid(np.stack([right, np.cross(forward, right), forward], axis=1), np.asarray(place, dtype=float))
    intrinsics = torch.tensor([[float(width), 0.0, width / 2], [0.0, float(width), height / 2], [0.0, 0.0, 1.0]])
    return View(intrinsics, torch.from_numpy(pose).float(), width, height, time)


def recording_of(scene: Scene, masks: Path | None = None, width: int | None = None, **holdout: int) -> EvaluationData:
    """A scene as a recording; nothing is held out but what `holdout` says."""
    settings = HoldoutSettings(**{"every_nth": 0, "last_block": 0, **holdout})
    seed = PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), {})
    job = ParserJob(holdout=settings, images=ImageSettings(width=width))
    return EvaluationData(scene, training_record(scene, seed, job), masks)


def write_labels(folder: Path, scene: Scene, labels: np.ndarray) -> Path:
    """The same label image (h, w) for every image of a scene, as the stage `masks` writes them; returns `folder`."""
    for frame in scene.frames:
        path = folder / mask_name("regions", frame.camera, frame.timestamp)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(labels).save(path)
    return folder
