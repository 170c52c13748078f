"""Rasterization: 3D Gaussians in; images, or LiDAR scans, out."""

from drivesplat.rasterization.rasterization import Rendering, rasterize
from drivesplat.rasterization.scans import RayGrid, ScanMotion, ScanRendering, rasterize_scan
from drivesplat.rasterization.surface_depth import rasterize_surface_depth

__all__ = [
    "RayGrid",
    "Rendering",
    "ScanMotion",
    "ScanRendering",
    "rasterize",
    "rasterize_scan",
    "rasterize_surface_depth",
]
