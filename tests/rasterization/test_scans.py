"""LiDAR scans on the CPU against the reference, which test_scan_closed_forms.py compares with closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.agreement import differing
from helpers.random_scans import ScanScene, even_rays, random_scan, uneven_rays
from torch.utils._python_dispatch import TorchDispatchMode

from drivesplat.kernels.numba import scan_tiles
from drivesplat.kernels.scan_compositing import composite_scan
from drivesplat.kernels.scan_part import MetPart
from drivesplat.kernels.scan_projection import scanned
from drivesplat.rasterization import RayGrid, ScanMotion
from drivesplat.scene.scan import ScanRays

AGREEMENT = 1e-5
"""Maximum error in float64, relative to the tensor's maximum."""
INPUTS = ("means", "quats", "scales", "opacities", "values", "world_to_sensor")
SEEN = ("range", "alpha", "values", "alpha_before")
PROJECTED = ("means2d", "conics", "slopes")
MOTION = ScanMotion(torch.tensor([9.0, -2.0, 0.5]).double(), torch.tensor([0.1, -0.2, 0.8]).double())


def seen_and_gradients(scene: ScanScene, backend: str = "cpu", **options) -> dict[str, torch.Tensor]:
    """What the rays measure, and the gradients of a fixed random weighting of all that has gradients."""
    inputs = {name: getattr(scene, name).detach().clone().requires_grad_() for name in INPUTS}
    rendering = replace(scene, **inputs).render(backend, before=torch.full_like(scene.rays.azimuths, 6.0), **options)
    projected = {f"{name} {i}": getattr(g, name) for i, g in enumerate(rendering.gaussians) for name in PROJECTED}
    for value in projected.values():
        value.retain_grad()
    seen = {name: getattr(rendering, name) for name in SEEN}
    generator = torch.Generator().manual_seed(1)
    weights = [torch.rand(v.shape, generator=generator, dtype=torch.float64).to(v) for v in seen.values()]
    torch.autograd.backward(list(seen.values()), weights)
    gradients = {f"gradient of {name}": value.grad for name, value in (inputs | projected).items()}
    found = {**seen, "median range": rendering.median_range, **gradients}
    return {name: value.detach() for name, value in found.items()}


def disagreements(scene: ScanScene, bound: float = AGREEMENT, **options) -> dict[str, float]:
    """The results that differ from the reference by more than `bound`, and their errors."""
    found, expected = (seen_and_gradients(scene, backend, **options) for backend in ("cpu", "reference"))
    return differing(found, expected, bound)


@pytest.mark.parametrize(("beams", "firings"), [(1, 1), (5, 7), (8, 32), (9, 33), (20, 130)])
def test_every_size_of_scan_agrees(beams, firings):
    """A revolution of 7 firings is a single tile that goes all the way round."""
    scene = random_scan(0, n=80, rays=even_rays(beams, firings))
    assert beams * firings == 1 or (scene.render().alpha > 0.1).any()
    assert not disagreements(scene)


def test_firings_in_any_order_agree():
    """Clockwise, beginning anywhere, and shuffled: tiles take their borders from their rays. Beams, too."""
    assert not disagreements(random_scan(2, n=120, rays=uneven_rays(2, 19, 150)))
    rays = even_rays(9, 100)
    for order in (torch.arange(99, -1, -1), torch.arange(100).roll(37), torch.randperm(100)):
        shuffled = RayGrid(*(getattr(rays, name)[:, order] for name in ("azimuths", "elevations", "offsets_s")))
        assert not disagreements(random_scan(4, n=60, rays=shuffled))


def test_azimuths_beyond_one_turn_are_those_within():
    scene = random_scan(5, n=40, rays=even_rays(8, 64))
    turned = replace(scene, rays=replace(scene.rays, azimuths=scene.rays.azimuths + 4.0 * np.pi))
    torch.testing.assert_close(turned.render().alpha, scene.render().alpha)


@pytest.mark.parametrize("channels", [0, 7])
def test_any_number_of_channels_agrees(channels):
    scene = random_scan(7, n=50, rays=even_rays(9, 40))
    scene.values = torch.from_numpy(np.random.default_rng(channels).normal(size=(50, channels)))
    assert not disagreements(scene)


def test_moving_sensor_and_gaussians_agree():
    scene = random_scan(6, n=100, rays=uneven_rays(6, 12, 120))
    velocities = torch.randn(100, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64) * 5.0
    assert not disagreements(scene, motion=MOTION)
    assert not disagreements(scene, motion=replace(MOTION, velocities=velocities))
    still, moved = scene.render().range, scene.render(motion=replace(MOTION, velocities=velocities)).range
    assert (still - moved).abs().max() > 0.1


def test_extreme_gaussians_agree():
    """Points, giants, needles and sheets; a zero quaternion; faint and opaque; near, far and at the poles."""
    scene = random_scan(30, n=64, rays=uneven_rays(30, 17, 90))
    scene.world_to_sensor = torch.eye(4, dtype=torch.float64)
    s = scene.scales
    s[:8], s[8:12], s[16:24, 1:], s[24:32, 0] = 1e-5, 4.0, 1e-2, 1e-3
    s[16:24, 0] = 2.0
    scene.quats[33] = 0.0
    scene.opacities[34:38] = torch.tensor([0.0, 1.001 / 255.0, 0.999 / 255.0, 1.0])
    scene.means[40:46] = torch.tensor(
        [[50.0, 0.0, 3.0], [0.0, -250.0, 2.0], [0.1, 0.0, 0.1], [0.0, 0.0, 3.0], [0.0, 0.0, 0.0], [0.2, 0.3, 0.0]]
    )
    found = seen_and_gradients(scene)
    assert all(value.isfinite().all() for value in found.values())
    assert not disagreements(scene)


def test_rays_that_end_early_agree():
    """With opaque Gaussians in many layers most lists are not processed to their end."""
    scene = random_scan(32, n=250, rays=even_rays(10, 70))
    scene.opacities[:] = torch.linspace(0.6, 1.0, 250)
    assert not disagreements(scene)


def test_equal_ranges_keep_their_order():
    scene = random_scan(31, n=60, rays=even_rays(10, 70))
    scene.world_to_sensor = torch.eye(4, dtype=torch.float64)
    scene.means[:, :] = torch.tensor([5.0, 1.0, 0.0])
    assert not disagreements(scene)


def test_without_gaussians_nothing_is_met():
    scene = random_scan(9, n=0, rays=even_rays(4, 20))
    found = seen_and_gradients(scene, motion=MOTION)
    assert all(not value.any() for value in found.values())
    assert found["values"].shape == (4, 20, 2)


def test_without_rays_there_is_an_error():
    scene = random_scan(9, n=3, rays=even_rays(4, 20))
    empty = RayGrid(*(torch.zeros(0, 20, dtype=torch.float64) for _ in range(3)))
    with pytest.raises(ValueError, match="needs rays; this one has 0 beams x 20"):
        replace(scene, rays=empty).render()


@pytest.mark.parametrize("azimuth", [np.pi, np.pi - 0.02])
def test_a_gaussian_at_any_azimuth_is_met_alike(azimuth):
    """At ±π, behind the sensor, as ahead of it: on both sides."""
    rays = even_rays(16, 360)
    ahead = random_scan(10, n=1, rays=rays)
    ahead.world_to_sensor, ahead.means[0] = torch.eye(4).double(), torch.tensor([6.0, 0.0, -0.3]).double()
    ahead.scales, ahead.opacities[:] = torch.tensor([[0.3, 0.6, 0.2]], dtype=torch.float64), 0.9
    turned = replace(ahead, rays=replace(rays, azimuths=rays.azimuths + azimuth))
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[np.cos(azimuth), -np.sin(azimuth)], [np.sin(azimuth), np.cos(azimuth)]])
    turned.world_to_sensor = turn
    expected, found = ahead.render(), turned.render()
    assert (expected.alpha > 0).sum() > 50
    for name in ("alpha", "range", "values", "median_range"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-9)


def test_the_number_of_windows_does_not_change_a_scan(monkeypatch):
    scene = random_scan(34, n=80, rays=even_rays(20, 130))
    whole = seen_and_gradients(scene)
    monkeypatch.setattr(scan_tiles, "MAX_ENTRIES", 40)
    windows = []
    listed = scan_tiles.scan_lists
    monkeypatch.setattr(
        scan_tiles, "scan_lists", lambda *given: (windows.append(given[2:]), (yield from listed(*given)))
    )
    for name, value in seen_and_gradients(scene).items():
        torch.testing.assert_close(value, whole[name], rtol=1e-10, atol=1e-10)
    assert len(windows) > 4


def test_recorded_rays_become_tensors_like_the_gaussians():
    angles, offsets = np.array([[0.1, 0.2]], np.float32), np.array([[0.0, 0.01]], np.float32)
    rays = RayGrid.of(ScanRays(angles, -angles, offsets), torch.zeros(3, dtype=torch.float64))
    found = (rays.azimuths, rays.elevations, rays.offsets_s)
    assert all(tensor.dtype == torch.float64 for tensor in found)
    assert [tensor.tolist() for tensor in found] == [array.tolist() for array in (angles, -angles, offsets)]


def test_float32_is_near_float64():
    scene = random_scan(35, n=100, rays=uneven_rays(35, 16, 100))
    expected, found = seen_and_gradients(scene), seen_and_gradients(scene.float())
    for name, truth in expected.items():
        error = (found[name] - truth).abs().flatten() / truth.abs().max()
        assert float(error.quantile(0.99)) < 1e-3, name


def test_gradients_are_those_of_finite_differences():
    """Where no range is limited: limits are taken as constants."""
    scene = random_scan(8, n=4, rays=even_rays(4, 16))
    scene.scales = 0.5 * scene.scales + 0.6
    scene.opacities = 0.5 + 0.4 * scene.opacities
    inputs = [getattr(scene, name).clone().requires_grad_() for name in INPUTS]

    def seen(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rendering = replace(scene, **dict(zip(INPUTS, values, strict=True))).render(beam_spread=(0.02, 0.02))
        return rendering.range * rendering.alpha, rendering.alpha, rendering.values

    assert float(seen(*inputs)[1].detach().mean()) > 0.05
    assert torch.autograd.gradcheck(seen, inputs, eps=1e-6, atol=1e-4, rtol=1e-3, fast_mode=True)


def test_gradients_of_projected_gaussians_are_those_of_finite_differences():
    """Of all that compositing reads, also where ranges are limited."""
    scene = random_scan(12, n=4, rays=even_rays(4, 16))
    projected = scene.render(beam_spread=(0.2, 0.1)).gaussians[0]
    names = ("means2d", "ranges", "conics", "slopes", "opacities")
    inputs = [getattr(projected, name).clone() for name in names]
    inputs[3] = 30.0 * inputs[3] + 5.0
    rays, limits = scene.rays, torch.tensor([0.2, 1.0, 2.0, 3.0]).double()

    def seen(values: torch.Tensor, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        gaussians = projected._replace(**dict(zip(names, tensors, strict=True)), range_limits=limits)
        met = MetPart(rays.whole, gaussians, torch.full_like(rays.azimuths, 7.0))
        return composite_scan([met], values)[0][:4]

    free = seen(scene.values, *inputs)[0]
    limits = limits * 1e6
    assert (seen(scene.values, *inputs)[0] != free).any()
    limits = limits * 1e-6
    inputs = [value.requires_grad_() for value in (scene.values, *inputs)]
    assert torch.autograd.gradcheck(seen, inputs, eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True)


def test_results_are_bitwise_equal_for_every_run_and_number_of_threads():
    """Of more Gaussians than torch gives to one thread."""
    scene = random_scan(39, n=40_000, rays=uneven_rays(39, 8, 60)).float()
    scene.scales = scene.scales * 0.05
    before, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            results.append(seen_and_gradients(scene, motion=_float(MOTION)))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(found[name], value) for found in results[1:] for name, value in results[0].items())


class ShapesOfProducts(TorchDispatchMode):
    """Collects the shapes that matrix products take."""

    def __init__(self):
        super().__init__()
        self.shapes: list[torch.Size] = []

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        if "mm" in operation.__name__:
            self.shapes += [value.shape for value in args if isinstance(value, torch.Tensor)]
        return operation(*args, **(kwargs or {}))


def test_projection_has_no_matrix_product_over_gaussians():
    """Its last bits, and those of its gradient, depend on the number of threads on some processors."""
    scene = random_scan(3, n=50, rays=even_rays(4, 16)).float()
    means, quats, scales, opacities, _, pose = (getattr(scene, name).requires_grad_() for name in INPUTS)
    with ShapesOfProducts() as products:
        (part,) = scanned(means, quats, scales, opacities, pose, None, (4e-3, 6e-3), 100.0)
        (part.means2d.sum() + part.conics.sum() + part.ranges.sum()).backward()
    assert pose.grad[:3].all() and not any(50 in shape for shape in products.shapes)


def _float(motion: ScanMotion) -> ScanMotion:
    return ScanMotion(motion.linear.float(), motion.angular.float())
