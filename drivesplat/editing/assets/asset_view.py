"""An asset alone, as a camera beside it sees it."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch

from drivesplat.editing.assets.asset import Asset
from drivesplat.editing.assets.inserted import part_of
from drivesplat.model.picture import Picture
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement, Want
from drivesplat.model.view import View

WIDTH, HEIGHT = 320, 240


@dataclass(frozen=True)
class AssetView:
    """A camera that looks at the middle of an asset from `azimuth`, radians to the left of its front, and `elevation`
    above it, from so many `diagonals` of its box away, which fill most of the image."""

    azimuth: float
    elevation: float = np.radians(15.0)
    diagonals: float = 1.9

    def of(self, size: np.ndarray) -> View:
        """The view of an asset of this size (metres)."""
        sine, cosine = np.sin(self.azimuth), np.cos(self.azimuth)
        around = np.array([cosine * np.cos(self.elevation), sine * np.cos(self.elevation), np.sin(self.elevation)])
        right, pose = np.array([-sine, cosine, 0.0]), np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(-around, right), -around], axis=1)
        pose[:3, 3] = self.diagonals * float(np.linalg.norm(size)) * around
        focal = 0.85 * self.diagonals * WIDTH
        K = np.array([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
        K, pose = (torch.from_numpy(values).float() for values in (K, pose))
        return View(K, pose, WIDTH, HEIGHT, time=0.0)


@torch.no_grad()
def seen_asset(asset: Asset, cameras: Iterable[AssetView]) -> list[tuple[Picture, View]]:
    """The picture of an asset by each camera, with the depth of its surfaces, and the view."""
    model = SplatModel([part_of("asset", asset, None)], None).requires_grad_(False)
    gaussians = model.at(0.0, Want(placements=(ActorPlacement("asset", object_to_world=np.eye(4)),)))
    views = [camera.of(asset.size) for camera in cameras]
    return [(model.render(view, gaussians=gaussians, with_surface_depth=True), view) for view in views]
