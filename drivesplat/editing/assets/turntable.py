"""A moving picture of an asset from all sides."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from drivesplat.editing.assets.asset import Asset
from drivesplat.editing.assets.inserted import part_of
from drivesplat.io.storage import atomic_write
from drivesplat.model.actor_placements import ActorPlacement
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import Want
from drivesplat.model.view import View

VIEWS, SECONDS = 24, 6.0
"""Pictures of a turn, and its duration."""
WIDTH, HEIGHT = 320, 240
ELEVATION = np.radians(15.0)
"""The angle under which the camera looks down."""
DISTANCE = 1.9
"""The distance of the camera in diagonals of the box."""
BACKDROP = 0.75
"""Grey level behind the asset."""
QUALITY = 80


def write_turntable(path: Path, asset: Asset) -> None:
    """Writes an animated WebP of a camera that goes round an asset, to its left, from its front on."""
    frames = [Image.fromarray(image) for image in turntable(asset)]
    with atomic_write(path) as file:
        moving = {"save_all": True, "append_images": frames[1:], "duration": round(1000 * SECONDS / VIEWS), "loop": 0}
        frames[0].save(file, format="WEBP", quality=QUALITY, **moving)


@torch.no_grad()
def turntable(asset: Asset, views: int = VIEWS) -> list[np.ndarray]:
    """Pictures (h, w, 3) uint8 of an asset from directions all around it, the first from its front."""
    model = SplatModel([part_of("asset", asset, None)], None).requires_grad_(False)
    want = Want(placements=(ActorPlacement("asset", object_to_world=np.eye(4)),))
    gaussians, found = model.at(0.0, want), []
    for azimuth in 2.0 * np.pi * np.arange(views) / views:
        picture = model.render(_view(azimuth, float(np.linalg.norm(asset.size))), gaussians=gaussians)
        shown = picture.splats + BACKDROP * (1.0 - picture.alpha[..., None])
        found.append((255.0 * shown.clamp(0.0, 1.0)).round().to(torch.uint8).numpy())
    return found


def _view(azimuth: float, diagonal: float) -> View:
    """The view of a camera in this direction, radians to the left of the front."""
    around = np.array([np.cos(azimuth) * np.cos(ELEVATION), np.sin(azimuth) * np.cos(ELEVATION), np.sin(ELEVATION)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-around, right), -around], axis=1)
    pose[:3, 3] = DISTANCE * diagonal * around
    focal = 0.85 * DISTANCE * WIDTH
    K = np.array([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
    K, pose = (torch.from_numpy(values).float() for values in (K, pose))
    return View(K, pose, WIDTH, HEIGHT, time=0.0)
