"""A moving picture of an asset from all sides."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from drivesplat.editing.assets.asset import Asset
from drivesplat.editing.assets.asset_view import AssetView, seen_asset
from drivesplat.io.storage import atomic_write

VIEWS, SECONDS = 24, 6.0
"""Pictures of a turn, and its duration."""
BACKDROP = 0.75
"""Grey level behind the asset."""
QUALITY = 80


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
