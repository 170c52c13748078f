"""`python -m drivesplat.training.warm_up`: a training of next to nothing on the processors.

What they run is compiled when it is first called, and kept (`drivesplat.kernels.cache`): some 15 seconds of the first
training, of each that is begun meanwhile, and of the first tests. The set-up has it behind it.
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
from drivesplat.lidar.occlusion import unhidden
from drivesplat.model.build import ModelInit, build_model
from drivesplat.model.view import View
from drivesplat.settings.train import TrainSettings
from drivesplat.training.train import Workspace, train
from drivesplat.training.views import TrainingView

ITERATIONS = 4
GAUSSIANS = 64
SIZE = 48, 32


def rehearse(folder: Path) -> None:
    """Trains GAUSSIANS before a sky for ITERATIONS of one image, densification included; leaves its files in `folder`.
    Nothing is learned, everything is compiled. Raises what a training raises."""
    random = np.random.default_rng(0)
    points = random.uniform((-2.0, -1.0, 4.0), (2.0, 1.0, 8.0), (GAUSSIANS, 3))
    record = {"points": points, "points_rgb": np.full((GAUSSIANS, 3), 128.0), "scene_scale": 5.0}
    settings = TrainSettings(
        iterations=ITERATIONS, cap_max=2 * GAUSSIANS, refine_start=0.0, refine_stop=1.0, sky_bce_weight=0.05
    )
    width, height = SIZE
    intrinsics = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    pixels = torch.full((height, width, 3), 200, dtype=torch.uint8)
    sky = torch.zeros(height, width, dtype=torch.bool)
    view = TrainingView(View(intrinsics, torch.eye(4), width, height, time=0.0), pixels, sky)
    model = build_model(ModelInit(record, [], np.full(3, 0.5)), ("background",), "cubemap", settings)
    workspace = Workspace(folder / "resume", folder / "tensorboard", "", "rehearsal")
    train(model, [view], settings, 0, torch.device("cpu"), workspace)
    pixel = np.zeros(1, dtype=np.int64)
    unhidden(pixel, pixel, np.ones(1), np.ones((1, 2)), (height, width))


def main(arguments: Sequence[str] = ()) -> int:
    """Returns the exit status."""
    argparse.ArgumentParser("python -m drivesplat.training.warm_up", description=__doc__).parse_args(arguments)
    logging.disable(logging.INFO)
    try:
        with tempfile.TemporaryDirectory() as folder:
            rehearse(Path(folder))
    except DriveSplatError as error:
        print(f"drivesplat: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
