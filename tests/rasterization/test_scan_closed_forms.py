"""LiDAR scans on the CPU against closed forms and ray casting."""

import math
from dataclasses import replace

import pytest
import torch
from helpers.random_scans import ScanScene, even_rays, random_scan
from scipy.spatial.transform import Rotation

from drivesplat.kernels.scan_compositing import composite_scan
from drivesplat.kernels.scan_part import MetPart
from drivesplat.rasterization import RayGrid, ScanMotion

HEIGHT = 1.8
"""Metres of the sensor above the road."""


def rays_at(azimuths: list[float], elevations: list[float]) -> RayGrid:
    grid = torch.meshgrid(
        torch.tensor(elevations, dtype=torch.float64), torch.tensor(azimuths, dtype=torch.float64), indexing="ij"
    )
    return RayGrid(grid[1].contiguous(), grid[0].contiguous(), torch.zeros_like(grid[0]))


def ahead(ranges: list[float], opacities: list[float], sigma: float = 0.1, rays: RayGrid | None = None) -> ScanScene:
    """Isotropic Gaussians of `sigma` metres on the sensor's x axis; one ray along it. Values: rows of the identity."""
    n = len(ranges)
    return ScanScene(
        means=torch.tensor([[r, 0.0, 0.0] for r in ranges], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(n, 1),
        scales=torch.full((n, 3), sigma, dtype=torch.float64),
        opacities=torch.tensor(opacities, dtype=torch.float64),
        values=torch.eye(3, dtype=torch.float64)[:n].clone(),
        world_to_sensor=torch.eye(4, dtype=torch.float64),
        rays=rays or rays_at([0.0], [0.0]),
    )


@pytest.mark.parametrize("elevation", [0.0, -0.4])
def test_one_gaussian_has_the_profile_of_the_closed_form(elevation):
    """Its standard deviations are sigma / (r cos elevation) and sigma / r, widened by the beams' footprint."""
    distance, sigma, opacity, spread = 8.0, 0.2, 0.7, (2e-3, 4e-3)
    offsets = [0.01 * i for i in range(-9, 10)]
    scene = ahead([distance], [opacity], sigma, rays_at(offsets, [elevation + o for o in offsets]))
    direction = torch.tensor([math.cos(elevation), 0.0, math.sin(elevation)], dtype=torch.float64)
    scene.means[0] = distance * direction
    rendering = scene.render(beam_spread=spread)
    variance_a = (sigma / distance / math.cos(elevation)) ** 2 + spread[0] ** 2
    variance_e = (sigma / distance) ** 2 + spread[1] ** 2
    o = torch.tensor(offsets, dtype=torch.float64)
    profile = opacity * torch.exp(-0.5 * (o[None] ** 2 / variance_a + o[:, None] ** 2 / variance_e))
    profile[profile < 1.0 / 255.0] = 0.0
    assert (profile == 0).any()
    torch.testing.assert_close(rendering.alpha, profile, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(rendering.values[..., 0], profile, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(rendering.range, distance * (profile > 0).double(), rtol=1e-9, atol=1e-9)


def test_the_projection_is_linear_in_azimuth_elevation_and_range():
    """Conics and slopes follow from the numerical Jacobian of the spherical coordinates."""
    scene = random_scan(1, n=20, rays=even_rays(2, 2))
    found = scene.render(beam_spread=(0.0, 0.0)).gaussians[0]
    view = scene.world_to_sensor

    def spherical(mean: torch.Tensor) -> torch.Tensor:
        x, y, z = view[:3, :3] @ mean + view[:3, 3]
        r = torch.sqrt(x * x + y * y + z * z)
        return torch.stack([torch.atan2(y, x), torch.asin(z / r), r])

    for g in range(20):
        w, *xyz = scene.quats[g].tolist()
        axes = torch.from_numpy(Rotation.from_quat([*xyz, w]).as_matrix()) * scene.scales[g]
        steps = [(spherical(scene.means[g] + 1e-6 * d) - spherical(scene.means[g] - 1e-6 * d)) / 2e-6 for d in axes.T]
        covariance = torch.stack(steps).T @ torch.stack(steps)
        a, b, c = found.conics[g]
        block = torch.linalg.inv(covariance[:2, :2])
        torch.testing.assert_close(torch.stack([a, b, c]), block[[0, 0, 1], [0, 1, 1]], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(found.slopes[g], block @ covariance[:2, 2], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(torch.cat([found.means2d[g], found.ranges[g : g + 1]]), spherical(scene.means[g]))


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_two_gaussians_composite_front_to_back_in_any_order(order):
    scene = ahead([3.0, 6.0], [0.6, 0.8])
    for name in ("means", "opacities", "values"):
        setattr(scene, name, getattr(scene, name)[order])
    rendering = scene.render(before=torch.tensor([[4.0]]).double())
    torch.testing.assert_close(rendering.values[0, 0], torch.tensor([0.6, 0.32, 0.0]).double())
    assert rendering.alpha.item() == pytest.approx(0.92)
    assert rendering.range.item() == pytest.approx((0.6 * 3.0 + 0.32 * 6.0) / 0.92)
    assert rendering.median_range.item() == pytest.approx(3.0)
    assert rendering.alpha_before.item() == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("opacities", "seen", "median"),
    [
        ([0.999 / 255.0], [0.0], 0.0),
        ([1.001 / 255.0], [1.001 / 255.0], 0.0),
        ([1.0, 0.5], [0.999, 0.0005], 3.0),
        ([0.97, 0.97, 0.97], [0.97, 0.03 * 0.97, 0.0], 3.0),
        ([0.4, 0.3, 0.5], [0.4, 0.18, 0.21], 4.0),
    ],
)
def test_cut_offs_of_alpha_and_the_median(opacities, seen, median):
    """Alpha is 1/255 to 0.999; a ray ends before its transmittance reaches 1e-4; the median is where it passes 0.5."""
    rendering = ahead([3.0, 4.0, 5.0][: len(opacities)], opacities, sigma=1e-3).render()
    assert rendering.values[0, 0, : len(seen)].tolist() == pytest.approx(seen)
    assert rendering.median_range.item() == pytest.approx(median)


@pytest.mark.parametrize(
    ("place", "met"),
    [
        ((0.19, 0.0, 0.0), False), ((0.21, 0.0, 0.0), True), ((49.0, 0.0, 0.0), True), ((51.0, 0.0, 0.0), False),
        ((0.5, 0.0, 5.0), False), ((1.0, 0.0, 5.0), True), ((-0.5, 0.0, -5.0), False), ((-9.0, -1.0, -1.0), True),
    ],
)  # fmt: skip
def test_near_far_and_polar_gaussians_are_skipped(place, met):
    x, y, z = place
    rays = rays_at([math.atan2(y, x)], [math.atan2(z, math.hypot(x, y))])
    scene = ahead([1.0], [0.8], sigma=1e-3, rays=rays)
    scene.means[0] = torch.tensor(place)
    rendering = scene.render(max_range=50.0)
    assert rendering.alpha.item() == pytest.approx(0.8 if met else 0.0)
    assert bool(rendering.gaussians[0].radii.any()) == met


def road(incidence: float, spacing: float = 0.1) -> tuple[ScanScene, torch.Tensor]:
    """A road of opaque flat Gaussians, rays that graze it at an angle (degrees), and their true ranges."""
    elevation = -math.radians(incidence)
    reach = HEIGHT / math.tan(-elevation)
    depth = 3.0 + reach * 0.006 / math.tan(-elevation)
    x = torch.arange(max(reach - depth, 1.0), reach + 2.0 * depth, spacing)
    y = torch.arange(-1.0, 1.0, spacing) * (1.0 + 0.03 * reach)
    x, y = (grid.flatten() for grid in torch.meshgrid(x, y, indexing="ij"))
    shift = 0.5 * spacing * torch.rand(2, len(x), generator=torch.Generator().manual_seed(0))
    rays = rays_at([0.001 * i for i in range(-16, 16)], [elevation + 0.0005 * i for i in range(-8, 8)])
    n = len(x)
    scene = ScanScene(
        means=torch.stack([x + shift[0], y + shift[1], torch.full_like(x, -HEIGHT)], dim=-1),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        scales=torch.tensor([[spacing, spacing, 1e-3]]).repeat(n, 1),
        opacities=torch.full((n,), 0.95),
        values=torch.zeros(n, 1),
        world_to_sensor=torch.eye(4),
        rays=rays,
    ).float()
    return scene, (HEIGHT / torch.sin(-rays.elevations)).float()


@pytest.mark.parametrize(("incidence", "spread"), [(30.0, 0.7e-3), (12.0, 0.3e-3), (5.0, 0.0), (5.0, 0.7e-3)])
def test_a_road_of_flat_gaussians_has_its_true_ranges_at_any_incidence(incidence, spread):
    """Within a centimetre; without slopes every ray ends at the nearest Gaussian's centre, decimetres too early."""
    scene, truth = road(incidence)
    rendering = scene.render(beam_spread=(spread, spread))
    assert rendering.alpha.min() > 0.95
    assert (rendering.range - truth).abs().max() < 0.01
    assert (rendering.median_range - truth).abs().max() < 0.01
    flat = rendering.gaussians[0]._replace(slopes=torch.zeros_like(rendering.gaussians[0].slopes))
    (found,) = composite_scan([MetPart(scene.rays.whole, flat)], scene.values)
    without = (found.range_sum / found.alpha - truth).abs()
    assert without.median() > 0.08


def test_slopes_are_limited_at_the_edges_of_gaussians():
    """A sheet seen almost edge-on ends where it ends: rays beside it do not follow its plane."""
    scene = ahead([10.0], [0.9], rays=rays_at([0.01 * i for i in range(-5, 6)], [0.0]))
    scene.scales[0] = torch.tensor([0.3, 0.001, 0.3])
    turn = math.radians(0.5)
    scene.quats[0] = torch.tensor([math.cos(0.5 * turn), 0.0, 0.0, math.sin(0.5 * turn)])
    rendering = scene.render(beam_spread=(1e-4, 1e-4))
    met = rendering.alpha > 0
    assert met.any() and (rendering.range[met] - 10.0).abs().max() < 1.0


def moving_scene() -> tuple[ScanScene, ScanMotion]:
    """A road between two walls of flat Gaussians, along which a fast sensor turns; the wall to the left moves."""
    spacing, rays = 0.3, even_rays(8, 128)
    x, u = torch.arange(-24.0, 24.0, spacing), torch.arange(0.0, 12.0, spacing)
    x, u = (grid.flatten() for grid in torch.meshgrid(x, u, indexing="ij"))
    flat, n = torch.zeros_like(x), len(x)
    places = [torch.stack([x, u - 6.0, flat - HEIGHT], dim=-1)]
    places += [torch.stack([x, flat + side, u - HEIGHT], dim=-1) for side in (6.0, -6.0)]
    scales = torch.tensor([[spacing, spacing, 1e-3], [spacing, 1e-3, spacing], [spacing, 1e-3, spacing]])
    scene = random_scan(3, 3 * n, rays)
    scene.means, scene.scales = torch.cat(places).double(), scales.repeat_interleave(n, dim=0).double()
    scene.quats[:], scene.opacities[:] = torch.tensor([1.0, 0.0, 0.0, 0.0]), 0.9
    velocities = torch.zeros(3 * n, 3, dtype=torch.float64)
    velocities[n : 2 * n] = torch.tensor([10.0, -8.0, 0.0])
    motion = ScanMotion(torch.tensor([25.0, 1.0, 0.3]).double(), torch.tensor([0.05, -0.1, 0.6]).double(), velocities)
    return scene, motion


FIRINGS = [*range(0, 128, 4), 127]


def firing_by_firing(scene: ScanScene, motion: ScanMotion) -> tuple[torch.Tensor, torch.Tensor]:
    """Range and alpha of FIRINGS, each on its own, from the sensor's pose and with Gaussians placed at its time."""
    columns = []
    sensor_to_world = torch.linalg.inv(scene.world_to_sensor)
    for j in FIRINGS:
        offset = scene.rays.offsets_s[0, j].item()
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(Rotation.from_rotvec(offset * motion.angular.numpy()).as_matrix())
        pose[:3, 3] = offset * motion.linear
        rays = RayGrid(*(getattr(scene.rays, name)[:, j : j + 1] for name in ("azimuths", "elevations", "offsets_s")))
        world_to_sensor = torch.linalg.inv(sensor_to_world @ pose)
        means = scene.means + offset * motion.velocities
        columns.append(replace(scene, means=means, world_to_sensor=world_to_sensor, rays=rays).render())
    return torch.cat([c.range for c in columns], dim=1), torch.cat([c.alpha for c in columns], dim=1)


def test_motion_is_that_of_rays_rendered_firing_by_firing():
    """Also where the revolution begins and ends, metres apart. Without motion ranges are decimetres off."""
    scene, motion = moving_scene()
    exact, alpha = firing_by_firing(scene, motion)
    found, still = scene.render(motion=motion), scene.render()
    seen = alpha > 0.9
    assert seen.float().mean() > 0.6
    error, without = (abs(rendering.range[:, FIRINGS] - exact)[seen] for rendering in (found, still))
    assert error.median() < 0.005 and (error < 0.02).double().mean() > 0.95
    assert without.median() > 0.2
    assert error.max() < 0.05, "where the revolution begins and ends, too"
    assert (exact[:, 0] - exact[:, -1])[seen[:, 0]].abs().median() > 1.0
    assert (found.alpha[:, FIRINGS] - alpha).abs().mean() < 0.01
