"""Rasterization: 3D Gaussians in; image, alpha and depth out."""

from drivesplat.rasterization.rasterization import rasterize
from drivesplat.rasterization.rendering import Rendering

__all__ = ["Rendering", "rasterize"]
