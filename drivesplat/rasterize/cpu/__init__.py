"""The rasterizer that newcomers and CI train with: tiles, numba kernels, analytic gradients."""

from drivesplat.rasterize.cpu.rasterizer import rasterize_cpu

__all__ = ["rasterize_cpu"]
