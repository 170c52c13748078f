"""Models and recordings small enough that a test can say what comes out of them."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from drivesplat.masks import mask_name
from drivesplat.model.background import SH_C0, Background
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.part import Part
from drivesplat.parser import parser_dict
from drivesplat.point_cloud import PointCloud
from drivesplat.recording import Recording
from drivesplat.scene import Scene
from drivesplat.settings.gaussians import GaussianSettings
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.images import ImageSettings
from drivesplat.settings.parser import ParserJob

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

    def at(self, time: float) -> Gaussians:
        return self._still.at(time)

    def learning_rates(self) -> dict[str, float]:
        return self._still.learning_rates()

    def of_track(self, track_id: str) -> torch.Tensor | None:
        return torch.ones(len(self), dtype=torch.bool) if track_id == self._track_id else None


def recording_of(scene: Scene, masks: Path | None = None, width: int | None = None, **holdout: int) -> Recording:
    """A scene as a recording; nothing is held out but what `holdout` says."""
    settings = HoldoutSettings(**{"every_nth": 0, "last_block": 0, **holdout})
    seed = PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), {})
    job = ParserJob(holdout=settings, images=ImageSettings(width=width))
    return Recording(scene, parser_dict(scene, seed, job), masks)


def write_labels(folder: Path, scene: Scene, labels: np.ndarray) -> Path:
    """The same label image (h, w) for every image of a scene, as the stage `masks` writes them; returns `folder`."""
    for frame in scene.frames:
        path = folder / mask_name("regions", frame.camera, frame.timestamp)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(labels).save(path)
    return folder
