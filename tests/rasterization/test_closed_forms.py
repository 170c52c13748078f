"""The CPU rasterizer against closed forms and a naive compositing of the whole image."""

import math

import numpy as np
import pytest
import torch
from helpers.random_gaussians import Scene, random_scene
from scipy.spatial.transform import Rotation

from drivesplat.rasterization import Rendering, rasterize

DILATION = 0.3
"""Pixels squared that 3DGS adds to the variance of every projected Gaussian."""
SH_C0 = 0.5 / math.sqrt(math.pi)
SH_C1 = math.sqrt(3.0 / (4.0 * math.pi))


def on_axis(
    depths: list[float], opacities: list[float], sigma: float = 0.5, focal: float = 20.0, size: int = 33
) -> Scene:
    """Isotropic Gaussians of `sigma` metres on the axis of a camera at the origin that looks along z.

    The axis meets the centre of the middle pixel. Their colours are the first rows of the identity.
    """
    n = len(depths)
    return Scene(
        means=torch.tensor([[0.0, 0.0, depth] for depth in depths], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(n, 1),
        scales=torch.full((n, 3), sigma, dtype=torch.float64),
        opacities=torch.tensor(opacities, dtype=torch.float64),
        colors=torch.eye(3, dtype=torch.float64)[:n].clone(),
        viewmats=torch.eye(4, dtype=torch.float64)[None],
        Ks=torch.tensor([[[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]]], dtype=torch.float64),
        width=size,
        height=size,
    )


def render(scene: Scene, **options) -> Rendering:
    return rasterize(**vars(scene), **options)


def middle(image: torch.Tensor) -> torch.Tensor:
    """The values of the middle pixel of the first camera."""
    return image[0, image.shape[1] // 2, image.shape[2] // 2]


def naive(scene: Scene, camera: int, antialiased: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image (h, w, 3), alpha (h, w) and expected depth (h, w): every Gaussian on every pixel, in numpy."""
    view, k = scene.viewmats[camera].numpy(), scene.Ks[camera].numpy()
    x, y = np.meshgrid(np.arange(scene.width) + 0.5, np.arange(scene.height) + 0.5)
    image, alpha_sum, depth_sum = np.zeros((scene.height, scene.width, 3)), np.zeros(x.shape), np.zeros(x.shape)
    transmittance, ended = np.ones(x.shape), np.zeros(x.shape, dtype=bool)
    in_camera = scene.means.numpy() @ view[:3, :3].T + view[:3, 3]
    for g in np.argsort(in_camera[:, 2]):
        depth = in_camera[g, 2]
        if depth < 0.01:
            continue
        covariance, center = _projected(scene, g, view, k, in_camera[g])
        dilated = covariance + DILATION * np.eye(2)
        opacity = float(scene.opacities[g])
        if antialiased:
            opacity *= math.sqrt(max(0.0, np.linalg.det(covariance) / np.linalg.det(dilated)))
        offset = np.stack([x, y], axis=-1) - center
        alpha = opacity * np.exp(-0.5 * np.einsum("...i,ij,...j", offset, np.linalg.inv(dilated), offset))
        alpha = np.where(alpha < 1.0 / 255.0, 0.0, np.minimum(alpha, 0.999))
        ended |= transmittance * (1.0 - alpha) <= 1e-4
        weight = np.where(ended, 0.0, alpha * transmittance)
        transmittance = np.where(ended, transmittance, transmittance * (1.0 - alpha))
        image += weight[..., None] * scene.colors[g].numpy()
        alpha_sum += weight
        depth_sum += weight * depth
    return image, alpha_sum, depth_sum / np.maximum(alpha_sum, 1e-10)


def _projected(scene: Scene, g: int, view: np.ndarray, k: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The 2D covariance of Gaussian `g` by the local affine approximation, and its centre in pixels."""
    w, *xyz = scene.quats[g].numpy()
    rotation = view[:3, :3] @ Rotation.from_quat([*xyz, w]).as_matrix()
    covariance = rotation @ np.diag(scene.scales[g].numpy() ** 2) @ rotation.T
    sizes, slopes = np.array([scene.width, scene.height]), at[:2] / at[2]
    focal, principal = k.diagonal()[:2], k[:2, 2]
    margin = 0.3 * 0.5 * sizes / focal  # 3DGS linearises no farther than 30 % of the half image beyond the border
    held = at[2] * np.clip(slopes, -principal / focal - margin, (sizes - principal) / focal + margin)
    jacobian = np.zeros((2, 3))
    jacobian[[0, 1], [0, 1]] = focal / at[2]
    jacobian[:, 2] = -focal * held / at[2] ** 2
    return jacobian @ covariance @ jacobian.T, focal * slopes + principal


@pytest.mark.parametrize(("depth", "sigma", "opacity"), [(4.0, 0.5, 0.7), (2.0, 0.05, 0.9), (10.0, 3.0, 0.3)])
def test_one_gaussian_has_the_profile_of_the_closed_form(depth, sigma, opacity):
    scene = on_axis([depth], [opacity], sigma)
    rendering = render(scene, with_depth=True)
    variance = (20.0 * sigma / depth) ** 2 + DILATION
    offset = torch.arange(33, dtype=torch.float64) - 16.0
    profile = opacity * torch.exp(-(offset[:, None] ** 2 + offset[None] ** 2) / (2.0 * variance))
    profile[profile < 1.0 / 255.0] = 0.0
    torch.testing.assert_close(rendering.alpha[0, ..., 0], profile, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(rendering.image[0], profile[..., None] * scene.colors[0], rtol=1e-12, atol=1e-14)
    assert float(middle(rendering.alpha)) == pytest.approx(opacity, rel=1e-12)


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_two_gaussians_composite_front_to_back_in_any_order(order):
    scene = on_axis([3.0, 6.0], [0.6, 0.8])
    for name in ("means", "opacities", "colors"):
        setattr(scene, name, getattr(scene, name)[order])
    rendering = render(scene, with_depth=True)
    expected = torch.tensor([0.6, 0.4 * 0.8, 0.0], dtype=torch.float64)
    torch.testing.assert_close(middle(rendering.image), expected)
    assert float(middle(rendering.alpha)) == pytest.approx(1.0 - 0.4 * 0.2)
    assert float(middle(rendering.depth)) == pytest.approx((0.6 * 3.0 + 0.32 * 6.0) / 0.92)


@pytest.mark.parametrize(
    ("opacities", "seen"),
    [
        pytest.param([0.999 / 255.0], [0.0], id="contributions below one grey level are dropped"),
        pytest.param([1.001 / 255.0], [1.001 / 255.0], id="those above are not"),
        pytest.param([1.0, 0.5], [0.999, 0.0005], id="the alpha of a Gaussian is at most 0.999"),
        pytest.param([0.97, 0.97, 0.97], [0.97, 0.03 * 0.97, 0.0], id="a ray ends before 1e-4 passes"),
        pytest.param([0.98, 0.999, 0.01], [0.98, 0.0, 0.0], id="nothing behind its end has an effect"),
    ],
)
def test_cut_offs_of_alpha(opacities, seen):
    rendering = render(on_axis([3.0, 4.0, 5.0][: len(opacities)], opacities))
    assert middle(rendering.image)[: len(seen)].tolist() == pytest.approx(seen)
    assert float(middle(rendering.alpha)) == pytest.approx(sum(seen))


def test_depth_is_expected_depth_and_zero_without_gaussians():
    rendering = render(on_axis([4.0], [0.7], sigma=0.1), with_depth=True)
    seen = rendering.alpha > 0
    assert seen.any() and not seen.all()
    torch.testing.assert_close(rendering.depth[seen], torch.full_like(rendering.depth[seen], 4.0))
    assert (rendering.depth[~seen] == 0).all()


def test_antialiasing_scales_opacity_by_the_area_that_the_dilation_adds():
    sigma, depth, opacity = 0.05, 4.0, 0.9
    rendering = render(on_axis([depth], [opacity], sigma), antialiased=True)
    variance = (20.0 * sigma / depth) ** 2
    assert float(middle(rendering.alpha)) == pytest.approx(opacity * variance / (variance + DILATION), rel=1e-9)


def test_spherical_harmonics_of_degree_1_follow_the_viewing_direction():
    scene = on_axis([4.0], [0.7])
    rng = np.random.default_rng(3)
    coefficients = rng.uniform(-0.4, 0.4, (4, 3))
    center, rotation = np.array([0.7, -1.3, 0.2]), Rotation.from_euler("xyz", [0.2, -0.15, 0.4]).as_matrix()
    scene.colors = torch.from_numpy(coefficients)[None]
    scene.viewmats[0, :3, :3] = torch.from_numpy(rotation)
    scene.viewmats[0, :3, 3] = torch.from_numpy(-rotation @ center)
    x, y, z = (np.array([0.0, 0.0, 4.0]) - center) / np.linalg.norm(np.array([0.0, 0.0, 4.0]) - center)
    basis = np.array([SH_C0, -SH_C1 * y, SH_C1 * z, -SH_C1 * x])
    rendering = render(scene, sh_degree=1)
    seen = rendering.alpha[0, ..., 0] > 0
    color = (rendering.image[0] / rendering.alpha[0])[seen]
    assert len(color) > 20
    torch.testing.assert_close(color, torch.from_numpy(0.5 + basis @ coefficients).expand_as(color))


def test_a_negative_color_is_rendered_black():
    scene = on_axis([4.0], [0.7])
    scene.colors = torch.tensor([[[-5.0, 0.2, -1.7]]], dtype=torch.float64)
    rendering = render(scene, sh_degree=0)
    color = middle(rendering.image) / middle(rendering.alpha)
    assert float(color[0]) == 0.0
    assert float(color[1]) == pytest.approx(0.5 + SH_C0 * 0.2)
    assert float(color[2]) == pytest.approx(0.5 - SH_C0 * 1.7)


@pytest.mark.parametrize(("width", "height", "antialiased"), [(37, 21, False), (5, 3, True), (49, 17, True)])
def test_an_image_does_not_depend_on_its_tiles(width, height, antialiased):
    """Several cameras render as each alone."""
    scene = random_scene(seed=width, n=60, width=width, height=height, cameras=2)
    rendering = render(scene, antialiased=antialiased, with_depth=True)
    for camera in range(2):
        image, alpha, depth = naive(scene, camera, antialiased)
        assert alpha.max() > 0.3
        np.testing.assert_allclose(rendering.image[camera].numpy(), image, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(rendering.alpha[camera, ..., 0].numpy(), alpha, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(rendering.depth[camera, ..., 0].numpy(), depth, rtol=1e-9, atol=1e-11)


def test_quaternions_need_not_be_normalised():
    scene = random_scene(seed=6, n=30, width=24, height=20)
    image = render(scene).image
    scene.quats = scene.quats * torch.linspace(0.1, 9.0, 30, dtype=torch.float64)[:, None]
    torch.testing.assert_close(render(scene).image, image)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(
    "place",
    [
        pytest.param([0.0, 0.0, -3.0], id="behind the camera"),
        pytest.param([50.0, 0.0, 3.0], id="beside the image"),
        pytest.param([0.0, -80.0, 2.0], id="above the image"),
        pytest.param([0.0, 0.0, 0.005], id="before the near plane"),
        pytest.param([1.0, 0.0, 0.0], id="in the camera's plane"),
        pytest.param([0.0, 0.0, 0.0], id="in the camera"),
    ],
)
def test_without_a_gaussian_in_view_images_are_zero_and_gradients_finite(place, antialiased):
    scene = on_axis([4.0], [0.9], sigma=0.2)
    scene.means = torch.tensor([place], dtype=torch.float64)
    inputs = [getattr(scene, name).requires_grad_() for name in ("means", "quats", "scales", "opacities", "colors")]
    rendering = render(scene, with_depth=True, antialiased=antialiased)
    for seen in (rendering.image, rendering.alpha, rendering.depth):
        assert (seen == 0).all()
    (rendering.image.sum() + rendering.alpha.sum() + rendering.depth.sum()).backward()
    for value in inputs:
        assert value.grad is None or (value.grad == 0).all()


def test_a_gaussian_out_of_view_leaves_the_gradients_of_others_finite():
    scene = on_axis([4.0, 5.0], [0.9, 0.9], sigma=0.2)
    scene.means[1] = torch.tensor([1.0, 0.0, 0.0])
    inputs = [getattr(scene, name).requires_grad_() for name in ("means", "quats", "scales", "opacities", "colors")]
    render(scene).image.square().sum().backward()
    for value in inputs:
        assert torch.isfinite(value.grad).all()
    assert float(inputs[3].grad[0]) > 0


def test_a_needle_seen_edge_on_has_finite_gradients_when_antialiased():
    """Its projected area is zero up to rounding, whose square root has an infinite slope."""
    n = 200
    scene = random_scene(seed=11, n=n, width=32, height=24)
    scene.scales = torch.tensor([[1.0, 1e-4, 1e-4]]).repeat(n, 1)
    scene = scene.float()
    inputs = [getattr(scene, name).requires_grad_() for name in ("means", "quats", "scales", "opacities", "colors")]
    render(scene, antialiased=True).image.sum().backward()
    for value in inputs:
        assert torch.isfinite(value.grad).all()


def test_an_empty_set_of_gaussians_gives_an_empty_image():
    scene = on_axis([], [])
    scene.means = scene.means.reshape(0, 3)
    rendering = render(scene, with_depth=True)
    assert rendering.image.shape == (1, 33, 33, 3)
    assert (rendering.image == 0).all() and (rendering.alpha == 0).all() and (rendering.depth == 0).all()
