"""LiDAR scans by Triton's kernels against the reference. Without a GPU they run in Triton's interpreter, see
conftest.py."""

from contextlib import contextmanager
from collections.abc import Iterator
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
import torch
from helpers.agreement import differing
from helpers.random_scans import ScanScene, even_rays, random_scan, uneven_rays

from drivesplat.kernels import triton_support
from drivesplat.rasterization import RayGrid, ScanMotion

pytest.importorskip("triton", reason="Triton is not there for this system")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
INPUTS = ("means", "quats", "scales", "opacities", "values")
SEEN = ("range", "alpha", "values", "alpha_before")
MOTION = ScanMotion(torch.tensor([9.0, -2.0, 0.5]).double(), torch.tensor([0.1, -0.2, 0.8]).double())


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
    return {name: value.detach().cpu() for name, value in found.items()}


def on_device(scene: ScanScene) -> ScanScene:
    scene = scene.float()
    rays = RayGrid(*(getattr(scene.rays, name).to(DEVICE) for name in ("azimuths", "elevations", "offsets_s")))
    tensors = {name: getattr(scene, name).to(DEVICE) for name in (*INPUTS, "world_to_sensor")}
    return replace(scene, **tensors, rays=rays)


def disagreements(scene: ScanScene, motion: ScanMotion | None = None) -> dict[str, float]:
    expected = seen_and_gradients(scene, "reference", motion=motion)
    if motion is not None:
        velocities = None if motion.velocities is None else motion.velocities.float().to(DEVICE)
        motion = ScanMotion(motion.linear.float().to(DEVICE), motion.angular.float().to(DEVICE), velocities)
    with patch.object(triton_support, "usable_for", lambda tensor: True):
        found = seen_and_gradients(on_device(scene), motion=motion)
    from drivesplat.kernels.triton import scan_compositing
    return {n: float((found[n] - t).abs().flatten().quantile(0.98) / t.abs().max()) for n, t in expected.items()}


@pytest.mark.parametrize(("beams", "firings"), [(1, 1), (5, 7), (8, 32), (9, 33), (20, 130)])
def test_every_size_of_scan_agrees(beams, firings):
    scene = random_scan(0, n=80, rays=even_rays(beams, firings))
    print(disagreements(scene))
    print(disagreements(scene, MOTION))
