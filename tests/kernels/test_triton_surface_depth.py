"""The depth of surfaces by Triton, compared with numba.

Without a GPU Triton's kernels run in its interpreter, see conftest.py.
"""

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not there for this system")
from helpers.tile_lists import DEVICE, HEIGHT, WIDTH, ellipses

from drivesplat.kernels.compositing import composite
from drivesplat.kernels.numba.surface_depth import surface_depth as on_cpu
from drivesplat.kernels.projection import ProjectedGaussians
from drivesplat.kernels.triton.surface_depth import surface_depth
from drivesplat.kernels.triton.tiles import tile_lists


@pytest.mark.parametrize("cameras", [1, 2])
def test_it_is_that_of_the_cpu(cameras):
    gaussians, radii, depths = ellipses(cameras, 80, WIDTH, HEIGHT, seed=4)
    slopes = torch.randn(cameras, 80, 2, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    gaussians = gaussians._replace(values=torch.cat([depths[..., None], 0.05 * slopes], dim=-1))
    lists = tile_lists(gaussians, radii, depths, WIDTH, HEIGHT)
    means, conics, planes, opacities = (values.cpu() for values in gaussians)
    projected = ProjectedGaussians(means, depths.cpu(), conics, radii.cpu(), opacities)
    alpha = composite(projected, planes, WIDTH, HEIGHT, absgrad=False).alpha.squeeze(-1)
    found = surface_depth(gaussians, lists, alpha.to(DEVICE)).cpu()
    assert found.shape == (cameras, HEIGHT, WIDTH)
    for c in range(cameras):
        expected = on_cpu(*(values[c] for values in (*projected, planes, alpha)))
        differs = (found[c] - expected).abs() > 1e-3
        assert differs.float().mean() < 0.01  # rounding may choose the neighbour of half
        assert (expected > 0.0).float().mean() > 0.9


def test_an_image_without_gaussians_has_depth_zero():
    gaussians, radii, depths = ellipses(1, 5, WIDTH, HEIGHT)
    lists = tile_lists(gaussians, torch.zeros_like(radii), depths, WIDTH, HEIGHT)
    assert (surface_depth(gaussians, lists, torch.zeros(1, HEIGHT, WIDTH, device=DEVICE)) == 0.0).all()
