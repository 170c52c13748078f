"""Projection with colors in one pass, compared with projection and colors one after the other.

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
from drivesplat.kernels.colored_projection import ColoredGaussians, PinholeCamera, project_with_colors
from drivesplat.kernels.projection import project
from drivesplat.kernels.view_colors import view_colors
from drivesplat.model.view import RollingShutter
from drivesplat.rasterization import rasterize_projected
from drivesplat.settings.train import TrainSettings
from drivesplat.training.losses import regularization

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


def a_camera() -> PinholeCamera:
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [0.1, 0.2, -0.1]).as_matrix()).float()
    viewmat[:3, 3] = torch.tensor([0.2, -0.1, 0.5])
    K = torch.tensor([[50.0, 0.0, 33.0], [0.0, 52.0, 24.0], [0.0, 0.0, 1.0]])
    tensors = (values.to(DEVICE) for values in (viewmat, torch.linalg.inv(viewmat), K))
    return PinholeCamera(*tensors, WIDTH, HEIGHT)


@pytest.mark.parametrize(("degrees", "with_depth"), [((1, 0), True), ((0, 0), False), ((1, 1), False)])
def test_projected_sets_and_their_gradients_equal_projection_and_colors(degrees, with_depth):
    """Sets with more, as many and fewer coefficients than are evaluated, and one without Gaussians."""
    generator, camera = torch.Generator().manual_seed(0), a_camera()
    sets = [a_set(150, 4, generator), a_set(0, 4, generator), a_set(60, 9 if degrees[1] else 1, generator)]
    found = project_with_colors(sets, camera, (degrees[0], 0, degrees[1]), with_depth)
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
    over = (projected.means2d - 0.5 * torch.tensor([WIDTH, HEIGHT], device=DEVICE)).abs()
    assert (over[seen] > 0.65 * torch.tensor([WIDTH, HEIGHT], device=DEVICE)).any(), "some slopes are clamped"
    listed = (projected.radii > 0).all(dim=-1) & (opacities > 1.0 / 255.0)
    assert not (seen & ~listed).any()
    # a radius that depends on the opacity leaves out what reaches no pixel with an alpha of 1/255
    means2d, reach = projected.means2d[0], found.gaussians.radii[0]
    (missed,) = (listed & ~seen)[0].nonzero(as_tuple=True)
    outside = ((means2d[missed] < 0) | (means2d[missed] > torch.tensor([WIDTH, HEIGHT], device=DEVICE))).any(dim=-1)
    assert outside.all() and not reach[missed].any()
    expected = [projected.means2d[seen], projected.conics[seen], projected.opacities, values[seen]]
    gaussians = found.gaussians
    ours = [gaussians.means2d[seen], gaussians.conics[seen], gaussians.opacities, found.values[seen]]
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


@pytest.fixture
def undefined_memory(monkeypatch):
    """Fills memory that is allocated without values with NaN, or the largest integer."""
    monkeypatch.setattr(torch.utils.deterministic, "fill_uninitialized_memory", True)
    torch.use_deterministic_algorithms(True, warn_only=True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.usefixtures("undefined_memory")
@pytest.mark.parametrize("behind", [False, True])
def test_what_is_out_of_view_reaches_no_image_and_no_gradient(behind):
    """Its rows are not written. Transparent Gaussians may hold anything, as preallocated rows do; and what does not
    learn takes part."""
    generator, camera = torch.Generator().manual_seed(0), a_camera()
    still = ColoredGaussians(*(values.detach() for values in a_set(30, 1, generator)))
    sets = [a_set(80, 4, generator), still]
    with torch.no_grad():
        for own in sets:
            own.means[:, 2] += -100.0 * behind
            for values in own[:3]:
                values[own.opacities == 0.0] = torch.nan
            own.scales[own.opacities == 0.0] = 0.1
    found = project_with_colors(sets, camera, (1, 0), True)
    rendering = rasterize_projected(found, WIDTH, HEIGHT, with_depth=True)
    assert behind != bool((rendering.alpha > 0.1).any())
    loss = rendering.image.sum() + rendering.alpha.sum() + rendering.depth.sum()
    gradients = torch.autograd.grad(loss, list(sets[0]))
    assert torch.isfinite(loss) and all(torch.isfinite(gradient).all() for gradient in gradients)
    assert gradients[3].any() != behind and gradients[0].any() != behind


def both_pictures(model, view, monkeypatch, **options):
    """A picture with the kernel and one without."""
    pictures = []
    for used in (True, False):
        monkeypatch.setattr(triton_support, "usable_for", lambda tensor, used=used: used)
        pictures.append(model.render(view, **options))
    return pictures


def a_view_on_device():
    view = a_view()
    return replace(view, K=view.K.to(DEVICE), camera_to_world=view.camera_to_world.to(DEVICE))


def test_pictures_of_a_model_and_their_gradients_are_those_of_separate_kernels(monkeypatch):
    """With depth, and the means that regularizers penalise."""
    model, settings = untrained_street(settings_of()).to(DEVICE), TrainSettings(opacity_reg=1.0, scale_reg=1.0)
    pictures = both_pictures(model, a_view_on_device(), monkeypatch, with_depth=True)
    assert [picture.sets.are_apart for picture in pictures] == [True, False], "the kernel needs no copy of all sets"
    shown = []
    for it, used in zip(pictures, (True, False), strict=True):
        monkeypatch.setattr(triton_support, "usable_for", lambda tensor, used=used: used)
        means = [mean for _, mean in regularization(it, model, settings).values()]
        shown.append([it.image, it.depth, *means])
    assert shown[1][0].std() > 0.01 and len(shown[1]) == 4
    for ours, theirs in zip(*shown, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
    weights = [torch.rand(value.shape, generator=torch.Generator().manual_seed(0)).to(DEVICE) for value in shown[0]]
    learned = [parameter for parameter in model.parameters() if parameter.requires_grad]
    ours, theirs = (
        torch.autograd.grad(
            sum((w * value).sum() for w, value in zip(weights, values, strict=True)), learned,
            allow_unused=True, materialize_grads=True,
        )
        for values in shown
    )  # fmt: skip
    for own, their in zip(ours, theirs, strict=True):
        torch.testing.assert_close(own, their, atol=1e-3, rtol=1e-3)
    assert sum(bool(gradient.any()) for gradient in ours) > 8


@pytest.mark.parametrize("case", ["antialiased", "max_scale", "surface_depth", "shutter", "learned_pose"])
def test_other_pictures_are_left_to_separate_kernels(case, monkeypatch):
    model, view, options = untrained_street(settings_of()).to(DEVICE), a_view_on_device(), {}
    if case == "antialiased":
        model.antialiased = True
    elif case == "max_scale":
        model.max_scale = 0.05
    elif case == "surface_depth":
        options["with_surface_depth"] = True
    elif case == "shutter":
        readout, motion = torch.tensor([0.0, 0.05, 0.0]), torch.zeros(3, 4)
        motion[0, 3] = 2.0
        view = replace(view, shutter=RollingShutter(readout.to(DEVICE), motion.to(DEVICE)))
    else:
        view = replace(view, camera_to_world=view.camera_to_world.clone().requires_grad_())
    with_kernel, without = both_pictures(model, view, monkeypatch, **options)
    assert not with_kernel.sets.are_apart
    torch.testing.assert_close(with_kernel.image, without.image, atol=1e-4, rtol=1e-4)


def test_positions_in_the_image_have_gradients_for_densification():
    generator, camera = torch.Generator().manual_seed(0), a_camera()
    sets = [a_set(60, 4, generator)]
    rendering = rasterize_projected(project_with_colors(sets, camera, [1], False), WIDTH, HEIGHT, absgrad=True)
    rendering.info["means2d"].retain_grad()
    rendering.image.square().sum().backward()
    means2d, seen = rendering.info["means2d"], (rendering.info["radii"] > 0).all(dim=-1)
    assert means2d.grad[seen].any() and (means2d.absgrad >= means2d.grad.abs() - 1e-5)[seen].all()


def test_other_cameras_and_colors_are_left_to_separate_kernels():
    generator, camera = torch.Generator().manual_seed(0), a_camera()
    sets, learned = [a_set(20, 9, generator)], camera._replace(viewmat=camera.viewmat.clone().requires_grad_())
    assert project_with_colors(sets, camera, [2], False) is None
    assert project_with_colors(sets, learned, [1], False) is None
    assert project_with_colors([a_set(0, 4, generator)], camera, [1], False) is None


def test_too_few_coefficients_are_refused():
    with pytest.raises(ValueError, match="degree 1 from 1 coefficients"):
        project_with_colors([a_set(20, 1, torch.Generator().manual_seed(0))], a_camera(), [1], False)
