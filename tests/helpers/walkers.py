"""A person who walks, with random deformations."""

import numpy as np
import torch

from drivesplat.model.deformable import Deformable
from drivesplat.settings.deformable import LatticeSettings
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import DeformableSettings
from drivesplat.trajectories.motion import Motion
from helpers.hand_made import motion_through, track_of
from helpers.hand_made_traffic import TURNING

SIZE, TIMES = (0.8, 0.6, 1.8), 0.5 * np.arange(9)


def walking(start: tuple[float, float, float] = (0.0, 2.0, 0.9), heading: float = 0.0, speed: float = 1.5) -> Motion:
    """Straight ahead for four seconds, from `start` (metres) with a `heading` (radians)."""
    ahead = speed * np.array([np.cos(heading), np.sin(heading), 0.0])
    return motion_through(TIMES, [start + t * ahead for t in TIMES], heading)


def walker(motion: Motion | None = None, count: int = 30, strength: float = 0.1) -> Deformable:
    """A part of `count` Gaussians that deform by displacements of about `strength` metres at the nodes of a lattice,
    and rotations of about twice as many radians."""
    rng = np.random.default_rng(0)
    track = track_of(walking() if motion is None else motion, TURNING, SIZE)
    settings = DeformableSettings(lattice=LatticeSettings(nodes=(3, 4, 5)))
    points, colors = rng.uniform(-0.4, 0.4, (count, 3)) * SIZE, rng.uniform(0.0, 1.0, (count, 3))
    part = Deformable.from_points([track], [points], [colors], settings, GaussianSettings())
    with torch.no_grad():
        part.shared["lattice"] += strength * torch.from_numpy(rng.normal(size=part.shared["lattice"].shape)).float()
    return part
