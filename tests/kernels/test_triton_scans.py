"""LiDAR scans by Triton's kernels, and on a GPU by CUDA C++ kernels, against the reference. Without a GPU Triton's run
in its interpreter, see conftest.py, and those in CUDA C++ are compiled for a processor once."""

from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest
import torch
from helpers.cuda_on_cpu import COMPILER, kernels_on_cpu
from helpers.random_scans import ScanScene, even_rays, random_scan, uneven_rays

from drivesplat.kernels import capacity, triton_support
from drivesplat.rasterization import RayGrid, ScanMotion

pytest.importorskip("triton", reason="Triton is not there for this system")
from drivesplat.kernels.cuda import scans as cuda_scans
from drivesplat.kernels.scanned_gaussians import ScannedGaussians
from drivesplat.kernels.triton import scan_tiles

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
ON_GPU = [pytest.mark.gpu, pytest.mark.skipif(DEVICE.type == "cpu", reason="no GPU")]
SLOW = [pytest.mark.slow] if DEVICE.type == "cpu" else []
"""Marks of what takes seconds in the interpreter, beside a test of the same kernels that is always run."""
RAYS = ("azimuths", "elevations", "offsets_s")
INPUTS = ("means", "quats", "scales", "opacities", "values")
SEEN = ("range", "alpha", "values", "alpha_before")
AGREEMENT = 1e-4
"""Maximum error of 98 % of the values of a tensor, relative to its maximum: in float32 a ray may end one Gaussian
earlier or later, or a Gaussian be met at the firing before or after."""
MOTION = ScanMotion(torch.tensor([9.0, -2.0, 0.5]).double(), torch.tensor([0.1, -0.2, 0.8]).double())


@pytest.fixture(autouse=True, params=["Triton", pytest.param("CUDA C++", marks=ON_GPU)])
def compositing(request, monkeypatch):
    """Which kernels composite."""
    if request.param == "Triton":
        monkeypatch.setattr(cuda_scans, "can_composite", lambda values: False)
    else:
        assert cuda_scans.can_composite(torch.ones(1, 2, device=DEVICE))


def seen_and_gradients(scene: ScanScene, backend: str = "cpu", **options) -> dict[str, torch.Tensor]:
    """What the rays measure, and the gradients of a fixed random weighting of all that has gradients."""
    inputs = {name: getattr(scene, name).detach().clone().requires_grad_() for name in INPUTS}
    rendering = replace(scene, **inputs).render(backend, before=torch.full_like(scene.rays.azimuths, 6.0), **options)
    seen = {name: getattr(rendering, name) for name in SEEN}
    generator = torch.Generator().manual_seed(1)
    weights = [torch.rand(v.shape, generator=generator, dtype=torch.float64).to(v) for v in seen.values()]
    torch.autograd.backward(list(seen.values()), weights)
    found = {**seen, "median range": rendering.median_range}
    found |= {f"gradient of {name}": value.grad for name, value in inputs.items()}
    return {name: value.detach().cpu().double() for name, value in found.items()}


def by_triton(scene: ScanScene, motion: ScanMotion | None = None) -> dict[str, torch.Tensor]:
    """As above, in float32 by Triton's kernels."""
    scene = scene.float()
    rays = RayGrid(*(getattr(scene.rays, name).to(DEVICE) for name in RAYS))
    scene = replace(
        scene, **{name: getattr(scene, name).to(DEVICE) for name in (*INPUTS, "world_to_sensor")}, rays=rays
    )
    if motion is not None:
        velocities = None if motion.velocities is None else motion.velocities.float().to(DEVICE)
        motion = ScanMotion(motion.linear.float().to(DEVICE), motion.angular.float().to(DEVICE), velocities)
    with patch.object(triton_support, "usable_for", lambda tensor: True):
        return seen_and_gradients(scene, motion=motion)


def disagreements(scene: ScanScene, motion: ScanMotion | None = None) -> dict[str, float]:
    """The results of which more than 2 % differ from the reference by more than the bound."""
    expected, found = seen_and_gradients(scene, "reference", motion=motion), by_triton(scene, motion)
    wrong = {}
    for name, truth in expected.items():
        assert found[name].shape == truth.shape and found[name].isfinite().all(), name
        apart = (found[name] - truth).abs().flatten()
        error = float(apart.quantile(0.98)) if len(apart) else 0.0
        if error > AGREEMENT * max(float(truth.abs().max()) if len(apart) else 0.0, 1e-3):
            wrong[name] = error
    return wrong


@pytest.mark.parametrize(("beams", "firings"), [(1, 1), pytest.param(9, 40, marks=SLOW)])
def test_every_size_of_scan_agrees(beams, firings):
    scene = random_scan(0, n=60, rays=even_rays(beams, firings))
    assert not disagreements(scene)


@pytest.mark.skipif(DEVICE.type != "cpu", reason="on a GPU all tests compare the kernels themselves")
@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")
def test_the_cuda_source_compiled_for_a_processor_agrees(monkeypatch, tmp_path):
    ran = []

    def kernels(program, channels, length, device):
        ran.append(program.name)
        return kernels_on_cpu(program, channels, length, tmp_path)

    monkeypatch.setattr(cuda_scans, "can_composite", lambda values: True)
    monkeypatch.setattr(cuda_scans, "kernels", cache(kernels))
    assert not disagreements(random_scan(0, n=60, rays=even_rays(5, 7)))
    assert ran == ["scans"]


@pytest.mark.parametrize("firings", [41, *(pytest.param(few, marks=SLOW) for few in (3, 1))])
def test_moving_sensor_and_gaussians_agree(firings):
    """Also where the halves of a revolution have different numbers of firings, and where there is one half."""
    scene = random_scan(6, n=50, rays=uneven_rays(6, 4, firings))
    velocities = torch.randn(50, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64) * 5.0
    assert not disagreements(scene, replace(MOTION, velocities=velocities) if firings > 1 else MOTION)


@pytest.mark.parametrize(
    "order",
    [
        pytest.param(torch.arange(79, -1, -1).roll(37), id="clockwise, beginning anywhere", marks=SLOW),
        pytest.param(torch.arange(97) % 80, id="more than a turn", marks=SLOW),
        pytest.param(torch.arange(20, 55), id="less than half a turn", marks=SLOW),
    ],
)
def test_firings_in_any_order_agree(order):
    rays = even_rays(3, 80)
    part = RayGrid(*(getattr(rays, name)[:, order] for name in RAYS))
    assert not disagreements(random_scan(4, n=50, rays=part))


@pytest.mark.parametrize("channels", [0, pytest.param(9, marks=SLOW)])
def test_any_number_of_channels_agrees(channels):
    scene = random_scan(7, n=30, rays=even_rays(3, 40))
    scene.values = torch.from_numpy(np.random.default_rng(channels).normal(size=(30, channels)))
    assert not disagreements(scene)


@pytest.mark.slow
def test_lists_of_planned_capacity_give_the_same_scan():
    """Those of a CUDA graph, with room for more Gaussians and entries than there are."""
    scene = random_scan(6, n=120, rays=uneven_rays(6, 4, 21))
    with capacity.exact() as needs:
        expected = by_triton(scene, MOTION)
    assert len(needs) == 4 and 0 < needs[0] < 120, "Gaussians and entries of either half"
    with capacity.planned(needs) as lists:
        found = by_triton(scene, MOTION)
    assert [int(needed) for needed, _ in lists] == needs
    for name, values in expected.items():
        torch.testing.assert_close(found[name], values, rtol=1e-5, atol=1e-6 * float(values.abs().max()), msg=name)


@pytest.mark.slow
def test_lists_that_overflow_give_a_part_of_the_scan_and_say_what_they_need(monkeypatch):
    monkeypatch.setattr(capacity, "MIN_CAPACITY", 0)
    monkeypatch.setattr(capacity, "MARGIN", 1.0)
    scene = random_scan(6, n=120, rays=uneven_rays(6, 4, 21))
    with capacity.exact() as needs:
        expected = by_triton(scene, MOTION)["alpha"]
    for planned in ([need // 2 for need in needs], [0, 0, 0, 0]):
        with capacity.planned(planned) as lists:
            found = by_triton(scene, MOTION)
        assert [int(needed) for needed, _ in lists] == needs and [planned for _, planned in lists] == planned
        assert all(values.isfinite().all() for values in found.values())
        assert found["alpha"].sum() < 0.95 * expected.sum() and (found["alpha"] > 0).any() == any(planned)


def test_the_last_rows_of_gaussians_are_left_out_where_they_do_not_fit():
    ranges = torch.tensor([50.0, 40.0, 30.0, 20.0, 10.0, 1.0], device=DEVICE)
    counts = torch.tensor([2, 0, 1, 3, 1, 1], dtype=torch.int32, device=DEVICE)
    counted = scan_tiles.CountedTiles(counts, torch.cumsum(counts > 0, dim=0, dtype=torch.int32))
    gaussians = ScannedGaussians(*(ranges for _ in ScannedGaussians._fields))
    found = [scan_tiles.reached_tiles(gaussians, counted, capacity) for capacity in (5, 3, 0)]
    assert [lists.nearest.tolist() for lists in found] == [[5, 4, 3, 2, 0], [3, 2, 0], []]
    assert [lists.ends.tolist() for lists in found] == [[1, 2, 5, 6, 8], [3, 4, 6], []]
    more = scan_tiles.reached_tiles(gaussians, counted, 8)
    assert more.nearest[:5].tolist() == [5, 4, 3, 2, 0] and more.counts.tolist() == [1, 1, 3, 1, 2, 0, 0, 0]
    assert [int(needed) for needed in counted.needed] == [5, 8]


@pytest.mark.parametrize("opacity", [pytest.param(share, marks=SLOW) for share in (0.02, 0.9)])
def test_lists_of_several_chunks_agree(opacity):
    """Of transparent Gaussians, where all chunks are seen, and of opaque ones, where rays end in the first."""
    scene = random_scan(32, n=600, rays=even_rays(1, 32))
    scene.scales[:, :] = 2.0
    scene.opacities[:] = opacity
    assert not disagreements(scene)


@pytest.mark.parametrize("seed", [pytest.param(30, marks=SLOW)])
def test_extreme_gaussians_agree(seed):
    """Points, giants, needles and sheets; faint and opaque; near, far and at the poles."""
    scene = random_scan(seed, n=64, rays=uneven_rays(seed, 6, 70))
    scene.world_to_sensor = torch.eye(4, dtype=torch.float64)
    s = scene.scales
    s[:8], s[8:12], s[16:24, 1:], s[24:32, 0] = 1e-5, 4.0, 1e-2, 1e-3
    s[16:24, 0] = 2.0
    scene.opacities[34:38] = torch.tensor([0.0, 1.001 / 255.0, 0.999 / 255.0, 1.0])
    scene.means[40:46] = torch.tensor(
        [[50.0, 0.0, 3.0], [0.0, -250.0, 2.0], [0.1, 0.0, 0.1], [0.0, 0.0, 3.0], [0.0, 0.0, 0.0], [0.2, 0.3, 0.0]]
    )
    assert not disagreements(scene)


def test_without_gaussians_nothing_is_met():
    found = by_triton(random_scan(9, n=0, rays=even_rays(4, 20)), MOTION)
    assert all(not value.any() for value in found.values())
    assert found["values"].shape == (4, 20, 2)


def test_the_gradient_of_the_pose_is_computed_without_triton():
    scene = random_scan(5, n=20, rays=even_rays(2, 40)).float()
    pose = scene.world_to_sensor.requires_grad_()
    with patch.object(triton_support, "usable_for", lambda tensor: DEVICE.type == "cpu"):
        scene.render().alpha.sum().backward()
    assert pose.grad is not None and pose.grad.any()


@pytest.mark.slow
def test_alpha_before_ranges_of_another_type_is_the_same():
    scene = random_scan(7, n=30, rays=even_rays(3, 40)).float()
    on_device = {name: getattr(scene, name).to(DEVICE) for name in (*INPUTS, "world_to_sensor")}
    rays = RayGrid(*(getattr(scene.rays, name).to(DEVICE) for name in RAYS))
    before = torch.full_like(rays.azimuths, 6.0)
    with patch.object(triton_support, "usable_for", lambda tensor: True):
        single, double = (
            replace(scene, **on_device, rays=rays).render("cpu", before=ranges).alpha_before
            for ranges in (before, before.double())
        )
    assert single.any() and torch.equal(single, double)
