"""A trained LiDAR, without a training."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from helpers.scan_drives import KEY_FRAME_US, room, scene_of, track_of

from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import RecordedScan
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
