"""`python -m drivesplat.training.warm_up`: a tiny training on the CPU that compiles and caches all CPU kernels.

Kernels are compiled on their first call and cached (`drivesplat.kernels.cache`), which takes some 15 seconds. The
set-up runs this so that neither trainings nor tests have to.
"""

import argparse
import logging
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from drivesplat.errors import DriveSplatError
from drivesplat.kernels.cube_map import face_coordinates
from drivesplat.lidar.occlusion import unoccluded
from drivesplat.model.background import Background
from drivesplat.model.scans import ScanView
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rasterization import RayGrid
from drivesplat.settings.train import TrainSettings
from drivesplat.settings.train_scans import ScanTrainingSettings
from drivesplat.training.scans import TrainingScan
from drivesplat.training.train import TrainingFolders, train
from drivesplat.training.views import TrainingView

ITERATIONS = 4
GAUSSIANS = 64
SIZE = 48, 32


def warm_up(folder: Path) -> None:
    """Trains GAUSSIANS and a sky for ITERATIONS on one image, with densification; leaves its files in `folder`. Raises
    what a training raises."""
    random = np.random.default_rng(0)
    points = random.uniform((-2.0, -1.0, 4.0), (2.0, 1.0, 8.0), (GAUSSIANS, 3))
    settings = TrainSettings(
        iterations=ITERATIONS, cap_max=2 * GAUSSIANS, refine_start=0.0, refine_stop=1.0, sky_bce_weight=0.05,
        scans=ScanTrainingSettings(per_image=1.0),
    )  # fmt: skip
    width, height = SIZE
    intrinsics = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    pixels = torch.full((height, width, 3), 200, dtype=torch.uint8)
    sky = torch.zeros(height, width, dtype=torch.bool)
    view = TrainingView(View(intrinsics, torch.eye(4), width, height, time=0.0), pixels, sky)
    colors = np.full((GAUSSIANS, 3), 0.5)
    part = Background.from_points(points, colors, settings.gaussians, extent=5.0, echo=(0.0, 0.0))
    model = SplatModel([part], CubemapSky(settings.sky_resolution, torch.full((3,), 0.5), settings.lr_sky))
    folders = TrainingFolders(folder / "resume", folder / "tensorboard", "", "warm-up")
    train(model, [view], settings, 0, torch.device("cpu"), folders, scans=[_scan()])
    face_coordinates(torch.ones(2, 2, 3))
    pixel = np.zeros(1, dtype=np.int64)
    unoccluded(pixel, pixel, np.ones(1), np.ones((1, 2)), (height, width))


def _scan() -> TrainingScan:
    """Rays that move, with and without a return, towards the Gaussians."""
    azimuths = torch.linspace(-0.3, 0.3, 40).expand(4, 40).contiguous()
    pose = torch.tensor([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    rays = RayGrid(azimuths, torch.linspace(-0.1, 0.1, 4)[:, None].expand(4, 40).contiguous(), 0.1 * azimuths)
    view = ScanView(pose, rays, torch.ones(3), torch.zeros(3), 0.0, (1e-3, 1e-3))
    returned = azimuths > 0.0
    return TrainingScan(view, torch.ones_like(returned), returned, 6.0 * returned, 0.5 * returned)


def main(arguments: Sequence[str] = ()) -> int:
    """Returns the exit status."""
    argparse.ArgumentParser("python -m drivesplat.training.warm_up", description=__doc__).parse_args(arguments)
    logging.disable(logging.INFO)
    try:
        with tempfile.TemporaryDirectory() as folder:
            warm_up(Path(folder))
    except DriveSplatError as error:
        print(f"drivesplat: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
