"""The CPU rasterizer against closed forms and a naive compositing of the whole image."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from helpers.random_gaussians import Scene, random_scene
from scipy.spatial.transform import Rotation

from drivesplat.rasterization import Rendering, rasterize

DILATION = 0.3
"""Pixels squared that 3DGS adds to the variance of every projected Gaussian."""
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]),
]
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


def naive(scene: Scene, camera: int, antialiased: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Image (h, w, 3), alpha (h, w), expected depth (h, w) and surface depth (h, w): every Gaussian on every pixel, in
    numpy. The plane of a Gaussian is the mean of depth under the condition of the pixel, by the joint covariance of
    pixel and depth."""
    view, k = scene.viewmats[camera].numpy(), scene.Ks[camera].numpy()
    pixels = np.stack(np.meshgrid(np.arange(scene.width) + 0.5, np.arange(scene.height) + 0.5), axis=-1)
    image, (alpha_sum, depth_sum) = np.zeros((scene.height, scene.width, 3)), np.zeros((2, scene.height, scene.width))
    transmittance, ended = np.ones(pixels.shape[:2]), np.zeros(pixels.shape[:2], dtype=bool)
    in_camera = scene.means.numpy() @ view[:3, :3].T + view[:3, 3]
    passed, planes = [], []
    for g in np.argsort(in_camera[:, 2]):
        depth = in_camera[g, 2]
        if depth < 0.01:
            continue
        joint, center = _projected(scene, g, view, k, in_camera[g])
        covariance = joint[:2, :2]
        dilated = covariance + DILATION * np.eye(2)
        opacity = float(scene.opacities[g])
        if antialiased:
            opacity *= math.sqrt(max(0.0, np.linalg.det(covariance) / np.linalg.det(dilated)))
        offset = pixels - center
        along = offset @ np.linalg.inv(dilated)
        alpha = opacity * np.exp(-0.5 * (offset * along).sum(axis=-1))
        alpha = np.where(alpha < 1.0 / 255.0, 0.0, np.minimum(alpha, 0.999))
        ended |= transmittance * (1.0 - alpha) <= 1e-4
        weight = np.where(ended, 0.0, alpha * transmittance)
        transmittance = np.where(ended, transmittance, transmittance * (1.0 - alpha))
        image += weight[..., None] * scene.colors[g].numpy()
        alpha_sum, depth_sum = alpha_sum + weight, depth_sum + weight * depth
        passed.append(alpha_sum)
        planes.append(depth + along @ joint[:2, 2])
    half = np.argmax(np.stack(passed) >= 0.5 * alpha_sum, axis=0)
    surface = np.take_along_axis(np.stack(planes), half[None], axis=0)[0]
    surface = np.where(alpha_sum > 0.0, np.maximum(surface, 0.01), 0.0)
    return image, alpha_sum, depth_sum / np.maximum(alpha_sum, 1e-10), surface


def _projected(scene: Scene, g: int, view: np.ndarray, k: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The covariance (3, 3) of column, row and depth of a Gaussian by local affine approximation, and its centre."""
    w, *xyz = scene.quats[g].numpy()
    rotation = view[:3, :3] @ Rotation.from_quat([*xyz, w]).as_matrix()
    covariance = rotation @ np.diag(scene.scales[g].numpy() ** 2) @ rotation.T
    sizes, slopes = np.array([scene.width, scene.height]), at[:2] / at[2]
    focal, principal = k.diagonal()[:2], k[:2, 2]
    margin = 0.3 * 0.5 * sizes / focal  # 3DGS linearises no farther than 30 % of the half image beyond the border
    held = at[2] * np.clip(slopes, -principal / focal - margin, (sizes - principal) / focal + margin)
    jacobian = np.eye(3)
    jacobian[[0, 1], [0, 1]] = focal / at[2]
    jacobian[:2, 2] = -focal * held / at[2] ** 2
    return jacobian @ covariance @ jacobian.T, focal * slopes + principal


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


@pytest.mark.parametrize(("width", "height", "antialiased"), [(37, 21, False), (5, 3, True), (49, 17, True)])
def test_an_image_does_not_depend_on_its_tiles(width, height, antialiased):
    """Several cameras render as each alone."""
    scene = random_scene(seed=width, n=60, width=width, height=height, cameras=2)
    rendering = render(scene, antialiased=antialiased, with_depth=True)
    for camera in range(2):
        image, alpha, depth, _ = naive(scene, camera, antialiased)
        assert alpha.max() > 0.3
        np.testing.assert_allclose(rendering.image[camera].numpy(), image, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(rendering.alpha[camera, ..., 0].numpy(), alpha, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(rendering.depth[camera, ..., 0].numpy(), depth, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_depth_of_surfaces_is_that_of_a_naive_compositing(antialiased, device):
    scene = random_scene(3, n=60, width=45, height=34, cameras=2)
    scene = replace(scene, means=scene.means * torch.tensor([0.5, 0.5, 1.0]))  # inside the projection's limits
    given = scene if device == "cpu" else scene.float()
    on_device = {f.name: getattr(given, f.name).to(device) for f in fields(Scene) if f.type is torch.Tensor}
    shown = render(replace(given, **on_device), antialiased=antialiased, with_surface_depth=True)
    found = shown.surface_depth.cpu().double().numpy()
    for camera in range(2):
        *_, expected = naive(scene, camera, antialiased)
        differs = np.abs(found[camera] - expected) > (1e-9 if device == "cpu" else 1e-3)
        assert differs.mean() < (1e-12 if device == "cpu" else 0.01)  # float32 may choose the neighbour of half
        assert 0.5 < (expected > 0.0).mean() < 1.0


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
