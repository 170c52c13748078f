"""The street of edits as LiDARs see it: vehicles whose boxes are full of Gaussians, a wall ahead, and recorded rays."""

import numpy as np
import torch
from torch import nn

from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import ActorTrack
from drivesplat.scene.scan import Scan, ScanRays
from drivesplat.scene.scan_record import ScanRecords
from drivesplat.scene.scene import Scene
from helpers.hand_made import actors_of, round_gaussians
from helpers.hand_made_street import DRIVERS, SETTINGS
from helpers.records import recorded_scan

WALL_AT = 80.0
"""Metres along the world's x axis."""
BEAMS, FIRINGS, REVOLUTION_S = 9, 240, 0.1
SPEED = 4.0
"""Of the tiny drive's ego vehicle, along x."""
UNMEASURED = slice(0, 10)
"""Firings that say nothing: they look back."""
LIDAR_LOGITS = {"wall": (-2.0, 4.0), "vehicle": (1.0, 5.0)}
"""Logits of intensity and of a return."""


def scanned_street(scene: Scene) -> SplatModel:
    """The actors of `hand_made_street` and a wall; a plate in the middle of the parked truck stands for its box."""
    y, z = np.meshgrid(np.arange(-30.0, 30.1, 0.5), np.arange(-4.0, 12.1, 0.5))
    wall = np.stack([np.full(y.size, WALL_AT), y.ravel(), z.ravel()], axis=1)
    y, z = np.meshgrid(np.arange(-1.0, 1.01, 0.1), np.arange(-1.2, 1.21, 0.1))
    parked = parked_truck(scene).object_to_world[0][:3, 3]
    plate = parked + np.stack([np.zeros(y.size), y.ravel(), z.ravel()], axis=1)
    static = round_gaussians(
        np.concatenate([wall, plate]), np.array([0.5] * len(wall) + [0.1] * len(plate), dtype=np.float32), 0.99
    )
    tracks = [ActorTrack(name, np.array(driver.size), driver.motion) for name, driver in DRIVERS.items()]
    actors = actors_of(*tracks, count=600, settings=SETTINGS.actors, shaken=False)
    with torch.no_grad():
        actors.params["scales"].fill_(float(np.log(0.2)))
        actors.params["opacities"].fill_(4.0)
    for part, name in ((static, "wall"), (actors, "vehicle")):
        logits = torch.zeros(len(part), 4, 2)
        logits[:, 0] = torch.tensor(LIDAR_LOGITS[name])
        part.params["lidar_logits"] = nn.Parameter(logits)
    return SplatModel([static, actors], None).requires_grad_(False)


def parked_truck(scene: Scene):
    return next(track for track in scene.tracks if track.category == "vehicle.truck" and track.id not in DRIVERS)


def scan_records(scene: Scene) -> ScanRecords:
    """Rays all around at the key frames of the tiny drive; a revolution ends at its timestamp."""
    around = np.linspace(-np.pi, np.pi, FIRINGS, endpoint=False, dtype=np.float32)[None].repeat(BEAMS, axis=0)
    up = np.linspace(-0.12, 0.04, BEAMS, dtype=np.float32)[:, None].repeat(FIRINGS, axis=1)
    offsets = (REVOLUTION_S * ((around + np.pi) / (2.0 * np.pi) - 1.0)).astype(np.float32)
    empty, measured = np.zeros((BEAMS, FIRINGS), dtype=np.float32), np.ones((BEAMS, FIRINGS), dtype=bool)
    measured[:, UNMEASURED] = False
    scan = Scan(ScanRays(around, up, offsets), empty > 0, empty, empty)
    fields = {"linear": np.array([SPEED, 0.0, 0.0]), "measured": measured}
    scans = [
        recorded_scan(
            scan, sweep.sensor_to_world, sweep.timestamp, sweep.sample_index, lidar=sweep.lidar,
            seconds=scene.seconds(sweep.timestamp), **fields,
        )
        for sweep in scene.sweeps
    ]  # fmt: skip
    return ScanRecords(scans, [track.id for track in scene.tracks])
