"""An asset alone, as a camera beside it sees it, and a moving picture of it from all sides."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from drivesplat.editing.assets.asset import Asset
from drivesplat.editing.assets.inserted import part_of
from drivesplat.io.storage import atomic_write
from drivesplat.model.picture import Picture
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement, Want
from drivesplat.model.view import View

VIEWS, SECONDS = 24, 6.0
"""Pictures of a turn, and its duration."""
BACKDROP = 0.75
"""Grey level behind the asset."""
QUALITY = 80
WIDTH, HEIGHT = 320, 240


def write_turntable(path: Path, asset: Asset) -> None:
    """Writes an animated WebP of a camera that goes round an asset, to its left, from its front on."""
    frames = [Image.fromarray(image) for image in turntable(asset)]
    with atomic_write(path) as file:
        moving = {"save_all": True, "append_images": frames[1:], "duration": round(1000 * SECONDS / VIEWS), "loop": 0}
        frames[0].save(file, format="WEBP", quality=QUALITY, **moving)


def turntable(asset: Asset, views: int = VIEWS) -> list[np.ndarray]:
    """Pictures (h, w, 3) uint8 of an asset from directions all around it, the first from its front."""
    found, azimuths = [], 2.0 * np.pi * np.arange(views) / views
    for picture, _ in seen_asset(asset, map(AssetView, azimuths.tolist())):
        shown = picture.splats + BACKDROP * (1.0 - picture.alpha[..., None])
        found.append((255.0 * shown.clamp(0.0, 1.0)).round().to(torch.uint8).numpy())
    return found


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
