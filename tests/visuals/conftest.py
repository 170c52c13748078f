"""A trained LiDAR without a training, and a car ahead of the ego vehicle."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from helpers.classed import classed
from helpers.scan_drives import KEY_FRAME_US, room, scene_of, track_of

from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.scene import Scene, Track
from drivesplat.visuals import trained_lidar
from drivesplat.visuals.trained_lidar import TrainedLidar

DRIVING = track_of("car", [(5.0 * i, 0.0, 0.0) for i in range(8)])
LIDAR_SCENE = dataclasses.replace(scene_of([], DRIVING), key_frame_timestamps=np.arange(8) * KEY_FRAME_US)


@pytest.fixture
def lidar_of(monkeypatch) -> Callable[..., TrainedLidar]:
    """A model of recorded scans whose every rendering is the one given: all rays return at 12.1 m unless told."""

    def made(scans: Sequence[RecordedScan], rendered: RenderedScan | None = None) -> TrainedLidar:
        shape = room().shape
        found = rendered or RenderedScan(room(12.1), np.zeros(shape), np.full(shape, 0.4))
        monkeypatch.setattr(trained_lidar, "rendered_scan", lambda *_: found)
        return TrainedLidar(SplatModel([], None), LIDAR_SCENE, list(scans), (1e-3, 1e-3), torch.device("cpu"))

    return made


@pytest.fixture(scope="session")
def one_car(tiny_scene) -> Callable[..., Scene]:
    """The tiny drive with a single car, whose centre is at (x, y, 0.8) at the first key frame."""

    def made(speed: float, x: float, y: float) -> Scene:
        times = tiny_scene.key_frame_timestamps
        seconds = (times - times[0]) * 1e-6
        places = np.stack([rigid(np.eye(3), np.array([x + speed * second, y, 0.8])) for second in seconds])
        size, seen = np.array([4.0, 2.0, 1.6]), np.full(len(times), 4)
        it = Track("it", *classed("vehicle.car"), size, times, np.arange(len(times)), places, seen)
        return dataclasses.replace(tiny_scene, tracks=(it,))

    return made
