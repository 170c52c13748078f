"""Gaussians as one camera sees them, in one pass, compared with their projection and colors one after the other.

Without a GPU Triton's kernels run in its interpreter, see conftest.py.
"""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not there for this system")
from helpers.densification import a_view
from helpers.tile_lists import DEVICE
from helpers.trainings import settings_of, untrained_street
from scipy.spatial.transform import Rotation

from drivesplat.kernels import triton_support
from drivesplat.kernels.projection import project
from drivesplat.kernels.regularizers import mean_opacity_and_scale
from drivesplat.kernels.view_colors import view_colors
from drivesplat.kernels.viewing import ColoredGaussians, PinholeView, viewed

WIDTH, HEIGHT = 64, 48


@pytest.fixture(autouse=True)
def uses_triton(monkeypatch):
    monkeypatch.setattr(triton_support, "usable_for", lambda tensor: True)


def a_set(count: int, coefficients: int, generator: torch.Generator) -> ColoredGaussians:
    """Gaussians around a camera: in view, beside it, behind it, transparent, and too faint to be seen."""
    means = torch.rand(count, 3, generator=generator) * torch.tensor([8.0, 6.0, 20.0]) - torch.tensor([4.0, 3.0, 2.0])
    quats, sh0 = (torch.randn(count, *size, generator=generator) for size in ((4,), (1, 3)))
    scales = 0.02 + 0.5 * torch.rand(count, 3, generator=generator)
    opacities = torch.rand(count, generator=generator)
    opacities[::9], opacities[1::9] = 0.0, 0.003
    shN = torch.randn(count, coefficients - 1, 3, generator=generator)
    tensors = (means, quats, scales, opacities, sh0, shN)
    return ColoredGaussians(*(values.to(DEVICE).requires_grad_() for values in tensors))


def a_camera() -> PinholeView:
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [0.1, 0.2, -0.1]).as_matrix()).float()
    viewmat[:3, 3] = torch.tensor([0.2, -0.1, 0.5])
    K = torch.tensor([[50.0, 0.0, 33.0], [0.0, 52.0, 24.0], [0.0, 0.0, 1.0]])
    tensors = (values.to(DEVICE) for values in (viewmat, torch.linalg.inv(viewmat), K))
    return PinholeView(*tensors, WIDTH, HEIGHT)


@pytest.mark.parametrize("with_depth", [True, False])
@pytest.mark.parametrize("degrees", [(1, 0), (0, 0), (1, 1)])
def test_viewed_sets_and_their_gradients_equal_projection_and_colors(degrees, with_depth):
    """Sets with more, as many and fewer coefficients than are evaluated, and one without Gaussians."""
    generator, camera = torch.Generator().manual_seed(0), a_camera()
    sets = [a_set(150, 4, generator), a_set(0, 4, generator), a_set(60, 9 if degrees[1] else 1, generator)]
    found = viewed(sets, camera, (degrees[0], 0, degrees[1]), with_depth)
    means, quats, scales, opacities = (torch.cat([own[at] for own in sets]) for at in range(4))
    projected = project(
        means, quats, scales, opacities, camera.viewmat[None], camera.K[None], WIDTH, HEIGHT, antialiased=False
    )
    colors = torch.cat([
        view_colors(own.means, torch.cat([own.sh0, own.shN], dim=1), camera.viewmat[None], radii, degree)
        for own, radii, degree in zip(
            sets, projected.radii.split([len(own.means) for own in sets], dim=1), (degrees[0], 0, degrees[1]),
            strict=True,
        )
    ], dim=1)  # fmt: skip
    values = torch.cat([colors, projected.depths[..., None]], dim=-1) if with_depth else colors
    seen = (found.gaussians.radii > 0).all(dim=-1)
    assert 100 < int(seen.sum()) < 150, "some are in view"
    listed = (projected.radii > 0).all(dim=-1) & (opacities > 1.0 / 255.0)
    assert not (seen & ~listed).any()
    # a radius that depends on the opacity leaves out what reaches no pixel with an alpha of 1/255
    means2d, reach = projected.means2d[0], found.gaussians.radii[0]
    (missed,) = (listed & ~seen)[0].nonzero(as_tuple=True)
    outside = ((means2d[missed] < 0) | (means2d[missed] > torch.tensor([WIDTH, HEIGHT], device=DEVICE))).any(dim=-1)
    assert outside.all() and not reach[missed].any()
    expected = [projected.means2d[seen], projected.conics[seen], projected.opacities, values[seen]]
    expected += mean_opacity_and_scale(opacities, scales)
    gaussians = found.gaussians
    ours = [gaussians.means2d[seen], gaussians.conics[seen], gaussians.opacities, found.values[seen]]
    ours += [found.mean_opacity, found.mean_scale]
    for theirs, own in zip(expected, ours, strict=True):
        torch.testing.assert_close(own, theirs, atol=2e-5, rtol=2e-5)
    torch.testing.assert_close(gaussians.depths[seen], projected.depths[seen])
    weights = [torch.randn(value.shape, generator=generator).to(DEVICE) for value in expected]
    leaves = [tensor for own in sets for tensor in own]
    by_theirs, by_ours = (
        torch.autograd.grad(
            sum((w * value).sum() for w, value in zip(weights, results, strict=True)), leaves,
            allow_unused=True, materialize_grads=True,
        )
        for results in (expected, ours)
    )  # fmt: skip
    for theirs, own in zip(by_theirs, by_ours, strict=True):
        torch.testing.assert_close(own, theirs, atol=1e-4, rtol=1e-4)
    assert all(gradient.any() for gradient in by_ours[:5])


def test_pictures_of_a_model_are_those_of_separate_kernels(monkeypatch):
    """With depth and the means that regularizers penalise."""
    model, view = untrained_street(settings_of()).to(DEVICE), a_view()
    view = replace(view, K=view.K.to(DEVICE), camera_to_world=view.camera_to_world.to(DEVICE))
    fused = model.render(view, with_depth=True)
    assert fused.means is not None
    monkeypatch.setattr(triton_support, "usable_for", lambda tensor: False)
    separate = model.render(view, with_depth=True)
    assert separate.means is None and separate.image.std() > 0.01
    pairs = [(fused.image, separate.image), (fused.depth, separate.depth)]
    for ours, theirs in [*pairs, *zip(fused.means, separate.mean_opacity_and_scale(), strict=True)]:
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)


def test_other_cameras_and_colors_are_left_to_separate_kernels():
    generator, camera = torch.Generator().manual_seed(0), a_camera()
    sets = [a_set(20, 9, generator)]
    assert viewed(sets, camera, [2], False) is None
    assert viewed(sets, camera._replace(viewmat=camera.viewmat.clone().requires_grad_()), [1], False) is None
    assert viewed([a_set(0, 4, generator)], camera, [1], False) is None
