"""A model of a street on the tiny drive with three actors whose ways are known in closed form, and its checkpoint."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.io.storage import no_provenance
from drivesplat.model.actors import Actors
from drivesplat.model.checkpoint import TrainedCheckpoint
from drivesplat.model.part import Part
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import ActorTrack
from drivesplat.model.view import View
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene, Track
from drivesplat.settings.render import FilmFormat
from drivesplat.settings.train import GaussianSettings, TrainJob, TrainSettings
from drivesplat.settings.train_objects import ActorSettings
from drivesplat.trajectories.motion import Motion
from helpers.classed import classed
from helpers.hand_made import about_z, round_gaussians
from helpers.hand_made import actors_of as made_actors

AHEAD, TURNING, GONE = "6e5c1111", "6e7d2222", "91ab3333"
"""Of the actors one drives straight ahead, one comes round a bend, one is absent for a while."""
SPEED = 6.0
KEY = 0.035 + 0.5 * np.arange(10)
"""Seconds of the tiny drive's key frames: 35 ms after their images, which run from 0 to 4.5 s."""
SETTINGS = TrainSettings(gaussians=GaussianSettings(sh_degree=0), actors=ActorSettings(fourier=2))
SKY = (0.3, 0.5, 0.8)


@dataclass(frozen=True)
class Driver:
    """An object that was annotated at the key frames `seen`, in order, where `way` says: object to world (4, 4) at a
    second. `size` is length, width, height in metres."""

    pose_at: Callable[[float], np.ndarray]
    size: tuple[float, float, float]
    seen: tuple[int, ...]
    category: str = "vehicle.car"

    @property
    def motion(self) -> Motion:
        return Motion(KEY[[*self.seen]], np.stack([self.pose_at(t) for t in KEY[[*self.seen]]]), self.runs, 0.25)

    @property
    def runs(self) -> tuple[tuple[int, int], ...]:
        ends = [i for i in range(1, len(self.seen)) if self.seen[i] != self.seen[i - 1] + 1]
        return tuple(zip([0, *ends], [*(i - 1 for i in ends), len(self.seen) - 1], strict=True))


def straight(seconds: float) -> np.ndarray:
    """Ahead on level ground."""
    return rigid(np.eye(3), np.array([9.0 + SPEED * seconds, 0.5, 0.75]))


def bend(seconds: float) -> np.ndarray:
    """Towards the camera, round a left turn of 20 m."""
    turned, began = 2.8 + 0.2 * seconds, 2.8
    displacement = 20.0 * np.array([np.sin(turned) - np.sin(began), np.cos(began) - np.cos(turned), 0.0])
    return rigid(about_z(turned), np.array([48.0, 4.0, 0.9]) + displacement)


def aside(seconds: float) -> np.ndarray:
    return rigid(about_z(0.1), np.array([14.0, -5.0, 1.6]) + 3.0 * seconds * np.array([np.cos(0.1), np.sin(0.1), 0.0]))


DRIVERS = {
    AHEAD: Driver(straight, (4.0, 1.8, 1.5), tuple(range(10))),
    TURNING: Driver(bend, (4.4, 2.0, 1.8), tuple(range(10))),
    GONE: Driver(aside, (7.0, 2.4, 3.0), (1, 2, 3, 6, 7, 8), "vehicle.truck"),
}


def street_scene(tiny: Scene) -> Scene:
    """The tiny drive with these vehicles in place of its vehicle; a truck is parked there and a pedestrian walks."""
    others = [track for track in tiny.tracks if track.category != "vehicle.car"]
    return replace(tiny, tracks=(*others, *(_track(tiny, name, driver) for name, driver in DRIVERS.items())))


def _track(scene: Scene, name: str, driver: Driver) -> Track:
    seen, poses = np.array(driver.seen), driver.motion.object_to_world
    timestamps = scene.key_frame_timestamps[seen]
    return Track(name, *classed(driver.category), np.array(driver.size), timestamps, seen, poses, np.full(len(seen), 4))


def street_actors() -> Actors:
    """All but the one that drives straight ahead have learned corrections of their tracks."""
    tracks = [ActorTrack(name, np.array(driver.size), driver.motion) for name, driver in DRIVERS.items()]
    actors = made_actors(*tracks, count=30, settings=SETTINGS.actors)
    with torch.no_grad():
        for correction in actors.shared.values():
            correction[: len(DRIVERS[AHEAD].seen)] = 0.0
    return actors


def street_model(*parts: Part) -> SplatModel:
    """Some 150 static Gaussians, the actors, and a sky of one colour; or just these parts before it."""
    rng = np.random.default_rng(0)
    places, colors = rng.uniform([5.0, -12.0, -0.5], [60.0, 12.0, 5.0], (150, 3)), rng.uniform(0.0, 1.0, (150, 3))
    made = parts or (round_gaussians(places, 0.4, colors=colors.tolist()), street_actors())
    return SplatModel(made, ConstantSky(torch.tensor(SKY), 1e-2)).requires_grad_(False)


def checkpoint_of(model: SplatModel, settings: TrainSettings = SETTINGS) -> TrainedCheckpoint:
    """What a training that ends with this model leaves."""
    parts = tuple(part.name for part in model.parts)
    job = TrainJob(parts=parts, sky="mask" if model.sky else "none", train=settings, random_seed=0)
    checkpoint = TrainedCheckpoint.of(model, job, no_provenance())
    return replace(checkpoint, model={name: value.clone() for name, value in checkpoint.model.items()})


def a_format(**changes: Any) -> FilmFormat:
    """A small film."""
    values = {"camera": "CAM_FRONT", "fps": 4, "width": 64, "height": 36, "horizontal_fov": None, "crf": 18}
    return FilmFormat(**values | changes)


def views_of(record: dict[str, Any], scene: Scene) -> list[View]:
    """The cameras that a film's record tells of."""
    K, size = torch.tensor(record["K"]), (record["width"], record["height"])
    poses = torch.tensor(record["camera_to_world"], dtype=torch.float64).float()
    return [
        View(K, pose, *size, time=scene.seconds(timestamp))
        for pose, timestamp in zip(poses, record["timestamps"], strict=True)
    ]


class Reels(dict[str, np.ndarray]):
    """In the encoder's place (`drivesplat.rendering.film.write_video`): what films were given, (n, h, w, 3), by their
    names."""

    def __call__(
        self, path: Path, frames: Iterable[np.ndarray], size: tuple[int, int], fps: int, crf: int, threads: int = 0
    ) -> None:
        self[path.stem] = np.stack([*frames])
        assert self[path.stem].shape[1:] == (size[1], size[0], 3)
        path.write_bytes(b"a film")
