"""Rasterization: 3D Gaussians in; image, alpha and depth out."""

from drivesplat.rasterization.rasterization import Rendering, rasterize

__all__ = ["Rendering", "rasterize"]
