"""Lists of the Gaussians that reach each tile of a LiDAR scan. Renderings with these lists are compared with a
reference in tests/rasterization/test_scans.py; here, that lists hold no more than that."""

import numpy as np
import torch
from helpers.random_scans import ScanScene, even_rays, random_scan

from drivesplat.kernels.numba import scan_tiles
from drivesplat.kernels.numba.layout import NumbaTileLists
from drivesplat.rasterization import RayGrid


def _lists_of(scene: ScanScene) -> NumbaTileLists:
    arrays = [tensor.numpy() for tensor in scene.render().gaussians[0]]
    arcs = scan_tiles.Arcs.of(scene.rays.whole.borders)
    (lists,) = scan_tiles.scan_lists(scan_tiles.by_range(*arrays, scene.values.numpy(), arcs), arcs)
    return lists


def test_tiles_list_only_gaussians_that_reach_them():
    """A small Gaussian within a tile is in one list; also where a tile lies on both sides of ±π."""
    rays = even_rays(16, 320)
    shifted = RayGrid(*(getattr(rays, name).roll(16, dims=1) for name in ("azimuths", "elevations", "offsets_s")))
    scene = random_scan(11, n=1, rays=shifted)
    scene.world_to_sensor, scene.scales = torch.eye(4).double(), torch.full((1, 3), 1e-3, dtype=torch.float64)
    for azimuth, column in ((0.0, 5), (0.95 * np.pi, 0), (np.pi, 0), (-0.85 * np.pi, 1), (0.85 * np.pi, 9)):
        direction = [np.cos(azimuth) * np.cos(0.1), np.sin(azimuth) * np.cos(0.1), np.sin(0.1)]
        scene.means[0] = 10.0 * torch.tensor(direction, dtype=torch.float64)
        lists = _lists_of(scene)
        assert np.flatnonzero(np.diff(lists.offsets)).tolist() == [10 + column], azimuth


def test_gaussians_that_no_ray_may_meet_are_not_sorted():
    """Behind half a revolution, and above or below all beams."""
    rays = even_rays(8, 200)
    ahead = RayGrid(*(getattr(rays, name)[:, 50:150] for name in ("azimuths", "elevations", "offsets_s")))
    scene = random_scan(13, n=4, rays=ahead)
    scene.world_to_sensor, scene.scales = torch.eye(4).double(), torch.full((4, 3), 1e-2, dtype=torch.float64)
    scene.means = torch.tensor([[-9.0, 1.0, 0.0], [9.0, 1.0, 0.0], [5.0, 0.0, 3.0], [5.0, 0.0, -4.0]]).double()
    arrays = [tensor.numpy() for tensor in scene.render().gaussians[0]]
    arcs = scan_tiles.Arcs.of(ahead.whole.borders)
    assert scan_tiles.by_range(*arrays, scene.values.numpy(), arcs).order.tolist() == [1]
