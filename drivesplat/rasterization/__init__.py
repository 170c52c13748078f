"""Rasterization: 3D Gaussians in; images, or LiDAR scans, out. One entry point per sensor. Kernels are in
`kernels`."""

from drivesplat.rasterization.rasterization import Rendering, rasterize, rasterize_projected
from drivesplat.rasterization.scans import RayGrid, ScanMotion, ScanRendering, rasterize_scan

__all__ = [
    "RayGrid",
    "Rendering",
    "ScanMotion",
    "ScanRendering",
    "rasterize",
    "rasterize_projected",
    "rasterize_scan",
]
