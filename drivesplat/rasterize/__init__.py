"""One door to the rasterizers: 3D Gaussians in, image, alpha and depth out."""

from drivesplat.rasterize.door import Rendering, rasterize

__all__ = ["Rendering", "rasterize"]
