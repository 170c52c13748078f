"""`python -m drivesplat.training.warm_up`: a tiny training on the CPU, which compiles and caches its CPU kernels.

Kernels are compiled on their first call and cached (`drivesplat.kernels.cache`), which takes some 15 seconds. The
set-up runs this so that neither trainings nor tests have to.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from drivesplat.kernels.cube_map import face_coordinates
from drivesplat.kernels.road_distance import Road
from drivesplat.kernels.sparse_grid import SparseGrid
from drivesplat.kernels.warm_up import run_warm_up
from drivesplat.lidar.occlusion import unoccluded
from drivesplat.model.background import Background
from drivesplat.model.scans import ScanView
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rasterization import RayGrid
from drivesplat.settings.train import ScanTrainingSettings, TrainSettings
from drivesplat.training.loop import TrainingFolders, train
from drivesplat.training.scans import TrainingScan
from drivesplat.training.views import TrainingView

ITERATIONS = 4
GAUSSIANS = 64
SIZE = 48, 32


def warm_up(folder: Path) -> None:
    """Trains GAUSSIANS on a road and a sky for ITERATIONS on one image, with densification, and renders their depth;
    leaves its files in `folder`. Raises what a training raises."""
    random = np.random.default_rng(0)
    points = random.uniform((-2.0, -1.0, 4.0), (2.0, 1.0, 8.0), (GAUSSIANS, 3))
    settings = TrainSettings(
        iterations=ITERATIONS, cap_max=2 * GAUSSIANS, refine_start=0.0, refine_stop=1.0, sky_bce_weight=0.05,
        road_weight=1.0, scans=ScanTrainingSettings(per_image=1.0),
    )  # fmt: skip
    width, height = SIZE
    intrinsics = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    pixels = torch.full((height, width, 3), 200, dtype=torch.uint8)
    sky = torch.zeros(height, width, dtype=torch.bool)
    view = TrainingView(View(intrinsics, torch.eye(4), width, height, time=0.0), pixels, sky)
    colors = np.full((GAUSSIANS, 3), 0.5)
    part = Background.from_points(points, colors, settings.gaussians, extent=5.0, lidar_logits=(0.0, 0.0))
    model = SplatModel([part], CubemapSky(settings.sky_resolution, torch.full((3,), 0.5), settings.lr_sky))
    folders = TrainingFolders(folder / "resume", folder / "tensorboard", "", "warm-up")
    train(model, [view], settings, 0, torch.device("cpu"), folders, _road(), scans=[_scan()])
    model.render(view.view, with_surface_depth=True)
    face_coordinates(torch.ones(2, 2, 3))
    pixel = np.zeros(1, dtype=np.int64)
    unoccluded(pixel, pixel, np.ones(1), np.ones((1, 2)), (height, width))


def _road() -> Road:
    """A plane of one cell around the Gaussians, one metre below the camera."""
    cells = SparseGrid(torch.tensor([-50.0, -50.0]), 100.0, (1, 1), torch.zeros(1, dtype=torch.long))
    return Road(cells, torch.tensor([[0.0, -1.0, 0.0]]), torch.tensor([-1.0]), torch.ones(1), reach=0.5)


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
    return run_warm_up("drivesplat.training.warm_up", warm_up, arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
