"""The training loss: its terms, their sum, and which way each pushes."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from drivesplat.model.background import Background
from drivesplat.model.sky import ConstantSky, CubemapSky
from drivesplat.model.splat_model import Picture, SplatModel, View
from drivesplat.settings.gaussians import GaussianSettings
from drivesplat.settings.train import TrainSettings
from drivesplat.training.losses import loss_terms, sky_alpha_loss, ssim
from drivesplat.training.views import TrainingView

WIDTH, HEIGHT = 20, 14


def random_image(seed: int, height: int = HEIGHT, width: int = WIDTH) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, 1, (height, width, 3))).float()


def a_model(sky: bool = True, gaussians: int = 12) -> SplatModel:
    rng = np.random.default_rng(4)
    part = Background.from_points(
        rng.uniform(-1, 1, (gaussians, 3)), rng.uniform(0, 1, (gaussians, 3)), GaussianSettings(), 1.0
    )
    with torch.no_grad():
        part.params["opacities"] += torch.linspace(-2, 2, gaussians)
    return SplatModel([part], ConstantSky(torch.full((3,), 0.5), 1e-2) if sky else None)


def a_view(pixels: torch.Tensor, sky: torch.Tensor | None) -> TrainingView:
    return TrainingView(View(torch.eye(3), torch.eye(4), WIDTH, HEIGHT, 0.0), pixels, sky)


def a_case(sky_known: bool = True) -> tuple[Picture, TrainingView]:
    """A random picture and a random recording of which the upper third is sky."""
    pixels = (random_image(1) * 255).to(torch.uint8)
    alpha = torch.from_numpy(np.random.default_rng(2).uniform(0.05, 0.95, (HEIGHT, WIDTH))).float()
    sky = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    sky[: HEIGHT // 3] = True
    image = random_image(3)
    return Picture(image, image, alpha, None, {}), a_view(pixels, sky if sky_known else None)


def zero_padded_ssim(image: np.ndarray, target: np.ndarray) -> float:
    """skimage's mean over the images in a wide frame of zeros, so that its own border handling reaches none of them."""
    framed = [np.pad(x.astype(np.float64), ((16, 16), (16, 16), (0, 0))) for x in (image, target)]
    _, full = structural_similarity(
        *framed,
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    return float(full[16:-16, 16:-16].mean())


@pytest.mark.parametrize("kind", ["unlike", "alike", "flat", "one pixel wide"])
def test_ssim_is_skimages(kind):
    image = random_image(5, 30, 1 if kind == "one pixel wide" else 24)
    target = {
        "unlike": random_image(6, 30, 24),
        "alike": (image + 0.05 * random_image(7, 30, image.shape[1])).clamp(max=1.0),
        "flat": torch.full_like(image, 0.4),
        "one pixel wide": random_image(6, 30, 1),
    }[kind]
    assert float(ssim(image, target)) == pytest.approx(zero_padded_ssim(image.numpy(), target.numpy()), abs=1e-4)


def test_ssim_of_an_image_with_itself_is_one():
    image = random_image(8)
    assert float(ssim(image, image)) == pytest.approx(1.0, abs=1e-5)


def test_ssim_has_the_gradient_of_finite_differences():
    image, target = random_image(9, 6, 5).double().requires_grad_(), random_image(10, 6, 5).double()
    assert torch.autograd.gradcheck(lambda x: ssim(x, target), image)


def test_colour_terms_are_weighted_l1_and_ssim():
    picture, view = a_case()
    settings = TrainSettings(ssim_weight=0.3)
    terms = loss_terms(picture, view, a_model(), settings)
    recorded = view.pixels.numpy() / 255.0
    assert float(terms["l1"]) == pytest.approx(0.7 * np.abs(picture.image.numpy() - recorded).mean(), rel=1e-5)
    similarity = zero_padded_ssim(picture.image.numpy(), recorded)
    assert float(terms["ssim"]) == pytest.approx(0.3 * (1.0 - similarity), abs=1e-4)


def test_regularisers_are_weighted_means_over_all_gaussians():
    picture, view = a_case()
    model = a_model()
    terms = loss_terms(picture, view, model, TrainSettings(opacity_reg=0.03, scale_reg=0.07))
    gaussians = model.parts[0].at(0.0)
    torch.testing.assert_close(terms["opacity_reg"], 0.03 * gaussians.opacities.mean())
    torch.testing.assert_close(terms["scale_reg"], 0.07 * gaussians.scales.mean())


def test_regularisers_of_several_parts_weigh_every_gaussian_alike():
    picture, view = a_case()
    parts = [a_model(gaussians=n).parts[0] for n in (3, 9)]
    terms = loss_terms(picture, view, SplatModel(parts, None), TrainSettings(opacity_reg=1.0))
    opacities = torch.cat([part.at(0.0).opacities for part in parts])
    torch.testing.assert_close(terms["opacity_reg"], opacities.mean())


@pytest.mark.parametrize(
    ("changed", "absent"),
    [
        ({"opacity_reg": 0.0}, "opacity_reg"),
        ({"scale_reg": 0.0}, "scale_reg"),
    ],
)
def test_a_weight_of_zero_leaves_a_term_out(changed, absent):
    picture, view = a_case()
    everything = {"l1", "ssim", "opacity_reg", "scale_reg", "sky_alpha"}
    assert loss_terms(picture, view, a_model(), TrainSettings()).keys() == everything
    assert loss_terms(picture, view, a_model(), TrainSettings(**changed)).keys() == everything - {absent}


@pytest.mark.parametrize(
    ("sky", "sky_known", "expected"),
    [
        pytest.param(ConstantSky(torch.full((3,), 0.5), 1e-2), True, True, id="one colour"),
        pytest.param(ConstantSky(torch.full((3,), 0.5), 1e-2), False, False, id="no sky mask"),
        pytest.param(CubemapSky(4, torch.full((3,), 0.5), 1e-2), True, False, id="a cube map holds tree tops too"),
        pytest.param(None, True, False, id="no sky in the model"),
    ],
)
def test_gaussians_are_kept_out_of_a_masked_sky_of_one_colour_alone(sky, sky_known, expected):
    picture, view = a_case(sky_known)
    model = SplatModel(list(a_model().parts), sky)
    terms = loss_terms(picture, view, model, TrainSettings(sky_alpha_weight=0.5))
    assert ("sky_alpha" in terms) is expected
    if expected:
        wanted = -0.5 * (torch.log(1.0 - picture.alpha) * view.sky).mean()
        torch.testing.assert_close(terms["sky_alpha"], wanted)


def test_sky_term_is_the_cross_entropy_on_sky_pixels():
    alpha = torch.tensor([[0.2, 0.5, 0.9], [0.99, 0.3, 0.0]])
    sky = torch.tensor([[True, False, True], [False, False, True]])
    expected = -(math.log(0.8) + math.log(0.1) + math.log(1.0)) / 6
    assert float(sky_alpha_loss(alpha, sky)) == pytest.approx(expected, rel=1e-5)


def test_sky_term_pushes_alpha_down_on_sky_pixels_alone():
    alpha = torch.tensor([[0.2, 0.5], [0.9, 0.3]], requires_grad=True)
    sky = torch.tensor([[True, False], [True, False]])
    sky_alpha_loss(alpha, sky).backward()
    torch.testing.assert_close(alpha.grad, torch.tensor([[1 / 0.8 / 4, 0.0], [1 / 0.1 / 4, 0.0]]))


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_sky_term_is_finite_where_alpha_is_full(alpha):
    value = torch.full((2, 2), alpha, requires_grad=True)
    loss = sky_alpha_loss(value, torch.ones(2, 2, dtype=torch.bool))
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(value.grad).all()


@pytest.mark.parametrize(("term", "parameter"), [("opacity_reg", "opacities"), ("scale_reg", "scales")])
def test_a_regulariser_makes_its_parameter_smaller_and_no_other(term, parameter):
    picture, view = a_case()
    model = a_model()
    loss_terms(picture, view, model, TrainSettings())[term].backward()
    params = model.parts[0].params
    assert (params[parameter].grad > 0).all()
    assert all(value.grad is None for name, value in params.items() if name != parameter)


@pytest.mark.parametrize("term", ["l1", "ssim"])
def test_a_colour_term_pulls_the_image_towards_the_recording(term):
    picture, view = a_case()
    image = picture.image.clone().requires_grad_()
    seen = Picture(image, image, picture.alpha, None, {})
    before = loss_terms(seen, view, a_model(), TrainSettings())[term]
    before.backward()
    colors = (image - 1e-2 * image.grad / image.grad.norm()).detach()
    stepped = Picture(colors, colors, picture.alpha, None, {})
    assert float(loss_terms(stepped, view, a_model(), TrainSettings())[term]) < float(before.detach())
    assert float((image.grad * (image - view.target())).sum().detach()) > 0


def test_a_perfect_picture_costs_nothing():
    _, view = a_case()
    settings = TrainSettings(opacity_reg=0, scale_reg=0)
    terms = loss_terms(
        Picture(view.target(), view.target(), torch.zeros(HEIGHT, WIDTH), None, {}), view, a_model(), settings
    )
    assert float(sum(terms.values()).detach()) == pytest.approx(0.0, abs=1e-5)
