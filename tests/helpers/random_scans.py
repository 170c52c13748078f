"""Gaussians placed at random around a LiDAR."""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from drivesplat.rasterization import RayGrid, ScanRendering, rasterize_scan
from helpers.reference_scans import rasterize_scan_reference

REVOLUTION_S = 0.1


@dataclass
class ScanScene:
    """n Gaussians, a sensor's pose and its rays."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    values: torch.Tensor
    world_to_sensor: torch.Tensor
    rays: RayGrid

    def render(self, backend: str = "cpu", **options) -> ScanRendering:
        rasterizer = {"cpu": rasterize_scan, "reference": rasterize_scan_reference}[backend]
        options = {"beam_spread": (4e-3, 6e-3), **options}
        return rasterizer(**{f.name: getattr(self, f.name) for f in fields(self)}, **options)

    def float(self) -> "ScanScene":
        """The scene in float32."""
        tensors = {f.name: getattr(self, f.name).float() for f in fields(self) if f.type is torch.Tensor}
        rays = RayGrid(self.rays.azimuths.float(), self.rays.elevations.float(), self.rays.offsets_s.float())
        return replace(self, **tensors, rays=rays)


def even_rays(beams: int, firings: int) -> RayGrid:
    """A revolution from -π of evenly spaced beams between -25° and 15°; it ends at the timestamp."""
    azimuths = torch.linspace(-np.pi, np.pi, firings + 1, dtype=torch.float64)[:-1].repeat(beams, 1)
    elevations = torch.linspace(-0.44, 0.26, beams, dtype=torch.float64)[:, None].repeat(1, firings)
    return RayGrid(azimuths, elevations, REVOLUTION_S * ((azimuths + np.pi) / (2.0 * np.pi) - 1.0))


def uneven_rays(seed: int, beams: int, firings: int) -> RayGrid:
    """Beams from the highest to the lowest, unevenly spaced, each with its own shift of azimuth, all rays jittered."""
    random = torch.Generator().manual_seed(seed)
    even = even_rays(beams, firings)
    gaps = torch.rand(beams, 1, generator=random, dtype=torch.float64) + 0.05
    elevations = (0.26 - 0.7 * gaps.cumsum(dim=0) / gaps.sum()).expand(beams, firings)
    shifts = 0.3 * torch.rand(beams, 1, generator=random, dtype=torch.float64)
    jitter = 2e-3 * torch.randn(2, beams, firings, generator=random, dtype=torch.float64)
    azimuths = torch.remainder(even.azimuths + shifts + jitter[0] + np.pi, 2.0 * np.pi) - np.pi
    return RayGrid(azimuths, elevations + jitter[1], even.offsets_s)


def random_scan(seed: int, n: int, rays: RayGrid) -> ScanScene:
    """Anisotropic Gaussians on all sides of a tilted sensor; some reach beyond its beams."""
    rng = np.random.default_rng(seed)
    azimuth, elevation, distance = rng.uniform(-np.pi, np.pi, n), rng.uniform(-0.6, 0.4, n), rng.uniform(2.0, 12.0, n)
    flat = np.cos(elevation)
    local = distance[:, None] * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    world_to_sensor = np.eye(4)
    world_to_sensor[:3, :3] = Rotation.from_euler("xyz", rng.uniform(-0.3, 0.3, 3)).as_matrix()
    world_to_sensor[:3, 3] = rng.uniform(-1.0, 1.0, 3)
    arrays = {
        "means": (local - world_to_sensor[:3, 3]) @ world_to_sensor[:3, :3],
        "quats": rng.normal(size=(n, 4)),
        "scales": np.exp(rng.uniform(-3.0, -0.3, (n, 3))),
        "opacities": rng.uniform(0.02, 1.0, n),
        "values": rng.uniform(-1.0, 1.0, (n, 2)),
        "world_to_sensor": world_to_sensor,
    }
    return ScanScene(**{name: torch.from_numpy(value) for name, value in arrays.items()}, rays=rays)
