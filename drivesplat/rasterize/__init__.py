"""One door to the rasterizers: 3D Gaussians in, image, alpha and depth out."""

from drivesplat.rasterize.door import rasterize
from drivesplat.rasterize.rendering import Rendering

__all__ = ["Rendering", "rasterize"]
