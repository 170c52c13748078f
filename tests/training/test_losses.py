"""The training loss: its terms, their sum, and which way each pushes."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers.hand_made import actors_of, looking_at, motion_through, track_of
from helpers.samples import sampled
from skimage.metrics import structural_similarity

from drivesplat.kernels.alpha_entropy import mean_cross_entropy, mean_entropy
from drivesplat.kernels.color_difference import masked_l1, ssim, ssim_in_torch
from drivesplat.model.background import Background
from drivesplat.model.gaussians import GaussianSets
from drivesplat.model.picture import Picture
from drivesplat.model.sky import ConstantSky, CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.settings.train import GaussianSettings, TrainSettings
from drivesplat.training.losses import (
    MAX_CURVATURE,
    class_cross_entropy,
    depth_loss,
    depth_roughness,
    loss_terms,
    sky_alpha_loss,
)
from drivesplat.training.views import LidarDepth, TrainingView

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


def a_case(model: SplatModel, sky_known: bool = True) -> tuple[Picture, TrainingView]:
    """A random picture of a model's Gaussians and a random recording of which the upper third is sky."""
    pixels = (random_image(1) * 255).to(torch.uint8)
    alpha = torch.from_numpy(np.random.default_rng(2).uniform(0.05, 0.95, (HEIGHT, WIDTH))).float()
    sky = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    sky[: HEIGHT // 3] = True
    return picture_of(model, random_image(3), alpha), a_view(pixels, sky if sky_known else None)


def picture_of(
    model: SplatModel, image: torch.Tensor, alpha: torch.Tensor, depth: torch.Tensor | None = None
) -> Picture:
    return Picture(GaussianSets(model.sample(model.states(0.0))), image, image, alpha, depth, {})


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


@pytest.mark.parametrize("measure", [ssim, ssim_in_torch])
@pytest.mark.parametrize("kind", ["unlike", "alike", "flat", "one pixel wide"])
def test_ssim_is_skimages(kind, measure):
    image = random_image(5, 30, 1 if kind == "one pixel wide" else 24)
    target = {
        "unlike": random_image(6, 30, 24),
        "alike": (image + 0.05 * random_image(7, 30, image.shape[1])).clamp(max=1.0),
        "flat": torch.full_like(image, 0.4),
        "one pixel wide": random_image(6, 30, 1),
    }[kind]
    assert float(measure(image, target)) == pytest.approx(zero_padded_ssim(image.numpy(), target.numpy()), abs=1e-4)


@pytest.mark.parametrize("threads", [1, 2])
def test_ssim_on_a_cpu_has_torchs_gradient(threads):
    """Of an image that is not contiguous, and larger than a chunk."""
    image, target = random_image(11, 40, 70).transpose(0, 1), random_image(12, 70, 40)
    gradients, before = [], torch.get_num_threads()
    torch.set_num_threads(threads)
    for measure in (ssim, ssim_in_torch):
        asked = image.clone().requires_grad_()
        (3.0 * measure(asked, target)).backward()
        gradients.append(asked.grad)
    torch.set_num_threads(before)
    torch.testing.assert_close(*gradients, atol=1e-8, rtol=1e-4)


@pytest.mark.parametrize("masked", [False, True])
def test_colour_terms_are_weighted_l1_and_ssim(masked):
    """Means over all pixels of the picture, with the recorded body of the ego vehicle before it."""
    picture, view = a_case(model := a_model())
    ego_mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    if masked:
        ego_mask[9:] = True
        view = dataclasses.replace(view, ego_mask=ego_mask)
    terms = loss_terms(picture, view, model, TrainSettings(ssim_weight=0.3))
    recorded = view.pixels.numpy() / 255.0
    shown = np.where(ego_mask[..., None], recorded, picture.image.numpy())
    assert float(terms["l1"].detach()) == pytest.approx(0.7 * np.abs(shown - recorded).mean(), rel=1e-5)
    assert float(terms["ssim"].detach()) == pytest.approx(0.3 * (1.0 - zero_padded_ssim(shown, recorded)), abs=1e-4)


def test_regularizers_are_weighted_means_over_all_gaussians():
    """Those of several parts weigh alike."""
    parts = [a_model(gaussians=n).parts[0] for n in (3, 9)]
    picture, view = a_case(model := SplatModel(parts, None))
    terms = loss_terms(picture, view, model, TrainSettings(opacity_reg=0.03, scale_reg=0.07))
    gaussians = [sampled(part, 0.0) for part in parts]
    torch.testing.assert_close(terms["opacity_reg"], 0.03 * torch.cat([own.opacities for own in gaussians]).mean())
    torch.testing.assert_close(terms["scale_reg"], 0.07 * torch.cat([own.scales for own in gaussians]).mean())


def test_a_weight_of_zero_leaves_a_term_out():
    picture, view = a_case(model := a_model())
    everything = {"l1", "ssim", "opacity_reg", "scale_reg", "sky_alpha"}
    assert loss_terms(picture, view, model, TrainSettings()).keys() == everything
    for absent in ("opacity_reg", "scale_reg"):
        assert loss_terms(picture, view, model, TrainSettings(**{absent: 0.0})).keys() == everything - {absent}


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
    model = SplatModel(list(a_model().parts), sky)
    picture, view = a_case(model, sky_known)
    terms = loss_terms(picture, view, model, TrainSettings(sky_alpha_weight=0.5))
    assert ("sky_alpha" in terms) is expected
    if expected:
        wanted = -0.5 * (torch.log(1.0 - picture.alpha) * view.sky).mean()
        torch.testing.assert_close(terms["sky_alpha"], wanted)


@pytest.mark.parametrize("weight", [0.0, 0.3])
def test_without_a_sky_mask_alpha_is_raised_where_there_is_certainly_no_sky_and_nowhere_else(weight):
    model = a_model()
    picture, view = a_case(model, sky_known=False)
    not_sky = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    not_sky[HEIGHT // 2 :] = True
    alpha = picture.alpha.clone().requires_grad_()
    seen = dataclasses.replace(picture, alpha=alpha)
    terms = loss_terms(seen, dataclasses.replace(view, not_sky=not_sky), model, TrainSettings(horizon_weight=weight))
    assert ("horizon" in terms) is (weight > 0)
    if weight:
        expected = -weight * (torch.log(picture.alpha) * not_sky).mean()
        torch.testing.assert_close(terms["horizon"], expected, atol=1e-4 * weight, rtol=0.0)
        (pull,) = torch.autograd.grad(terms["horizon"], alpha)
        assert (pull[not_sky] < 0).all() and not pull[~not_sky].any()


def test_sky_term_is_the_cross_entropy_on_sky_pixels_and_finite():
    alpha = torch.tensor([[0.2, 0.5, 0.9], [0.99, 0.3, 0.0]], requires_grad=True)
    sky = torch.tensor([[True, False, True], [False, False, True]])
    loss = sky_alpha_loss(alpha, sky)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(-(math.log(0.8) + math.log(0.1)) / 6, rel=1e-5)
    torch.testing.assert_close(alpha.grad[:, :2], torch.tensor([[1 / 0.8 / 6, 0.0], [0.0, 0.0]]))
    assert float(alpha.grad[0, 2]) == pytest.approx(1 / 0.1 / 6) and torch.isfinite(alpha.grad).all()
    full = torch.ones(2, 2, requires_grad=True)
    loss = sky_alpha_loss(full, torch.ones(2, 2, dtype=torch.bool))
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(full.grad).all()


# ---- the terms of models that move


def test_the_cross_entropy_of_the_sky_is_closed_form_and_finite():
    """-ln (1 - alpha) on the sky, -ln alpha elsewhere; alphas of 0 and 1 count as 1e-4 from them."""
    alpha = torch.tensor([[0.2, 0.7, 0.0], [0.9, 1.0, 1.0]], requires_grad=True)
    sky = torch.tensor([[True, False, True], [True, False, True]])
    loss = mean_cross_entropy(alpha, sky)
    terms = [0.8, 0.7, 1.0 - 1e-4, 0.1, 1.0 - 1e-4, 1e-4]
    assert float(loss.detach()) == pytest.approx(-np.log(terms).mean(), rel=1e-3)
    loss.backward()
    assert torch.isfinite(alpha.grad).all()
    np.testing.assert_allclose(alpha.grad[0, :2], [1 / 0.8 / 6, -1 / 0.7 / 6], rtol=1e-4)


def a_lidar(count: int, seed: int = 0) -> tuple[torch.Tensor, LidarDepth, np.ndarray]:
    """A random depth image, what LiDAR measured at some of its pixels, and by how much it is off there."""
    rng = np.random.default_rng(seed)
    depth, pixels = rng.uniform(2, 60, (HEIGHT, WIDTH)), rng.permutation(HEIGHT * WIDTH)[:count]
    off = rng.normal(size=count) * 3.0
    measured = depth[pixels // WIDTH, pixels % WIDTH] + off
    lidar = LidarDepth(torch.from_numpy(pixels), torch.from_numpy(measured).float())
    return torch.from_numpy(depth).float(), lidar, np.abs(off)


@pytest.mark.parametrize(("count", "kept"), [(100, 95), (200, 190), (19, 18), (1, 1)])
def test_depth_is_compared_where_lidar_measured_and_the_worst_twentieth_left_out(count, kept):
    depth, lidar, off = a_lidar(count)
    loss = depth_loss(depth.requires_grad_(), lidar)
    assert float(loss.detach()) == pytest.approx(np.sort(off)[:kept].mean(), rel=1e-4)
    loss.backward()
    gradient = depth.grad.reshape(-1)
    assert set(gradient.nonzero()[:, 0].tolist()) == set(lidar.pixels[np.argsort(off)[:kept]].tolist())
    np.testing.assert_allclose(gradient[gradient != 0.0].abs(), 1 / kept, rtol=1e-5)


def depth_of_plane(normal: tuple[float, float, float], offset: float, size: int = 24) -> torch.Tensor:
    """The depths (size, size) at which the rays of a camera with a focal length of `size` pixels meet the plane of
    points p with normal · p = offset."""
    rows, columns = torch.meshgrid(*[(torch.arange(size) + 0.5) / size - 0.5] * 2, indexing="ij")
    return offset / (normal[0] * columns + normal[1] * rows + normal[2])


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, -0.2, 0.5), (0.0, 1.2, 0.9)])
def test_a_plane_is_even_and_a_bumpy_one_is_not(normal):
    depth, grey, opaque = depth_of_plane(normal, 5.0), torch.full((24, 24, 3), 0.5), torch.ones(24, 24)
    assert float(depth_roughness(depth, opaque, grey)) < 1e-5
    bumps = 1.0 + 0.01 * torch.from_numpy(np.random.default_rng(0).choice([-1.0, 1.0], (24, 24))).float()
    bumpy, transparent = depth * bumps, opaque.clone()
    found = float(depth_roughness(bumpy, opaque, grey))
    inverse = (1.0 / bumpy).double().numpy()
    expected = sum(
        np.abs(np.diff(values, 2, axis=0) / values[1:-1]).clip(max=MAX_CURVATURE).mean()
        for values in (inverse, inverse.T)
    )
    assert found == pytest.approx(expected, rel=1e-4)
    transparent[:, 12:] = 0.5
    assert float(depth_roughness(bumpy, transparent, grey)) < 0.6 * found
    spotted = grey.clone()
    spotted[:, ::3] = 0.0
    assert float(depth_roughness(bumpy, opaque, spotted)) < found


def test_edges_of_objects_are_not_smoothed():
    depth = torch.full((6, 20), 10.0)
    depth[:, 8:] = 4.0
    depth[:, 13:] = 4.1
    depth.requires_grad_()
    depth_roughness(depth, torch.ones(6, 20), torch.full((6, 20, 3), 0.5)).backward()
    pulled = depth.grad.abs().sum(dim=0).nonzero()[:, 0].tolist()
    assert pulled == [11, 12, 13, 14]


def test_what_the_ego_vehicle_hides_is_not_smoothed():
    model = a_model()
    _, view = a_case(model)
    body = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    body[10:] = True
    depth = torch.from_numpy(np.random.default_rng(8).uniform(9.5, 10.5, (HEIGHT, WIDTH))).float().requires_grad_()
    picture = picture_of(model, random_image(3), torch.ones(HEIGHT, WIDTH), depth)
    terms = loss_terms(picture, dataclasses.replace(view, ego_mask=body), model, TrainSettings(smoothness_weight=1.0))
    terms["smoothness"].backward()
    assert not depth.grad[10:].any() and depth.grad[:10].any()


def test_entropy_is_that_of_a_coin():
    """With a finite gradient, which for certain pixels too pushes away from even."""
    alpha = torch.tensor([[0.5, 0.1], [0.9, 0.3]], requires_grad=True)
    expected = np.mean([-(o * np.log(o) + (1 - o) * np.log(1 - o)) for o in (0.5, 0.1, 0.9, 0.3)])
    loss = mean_entropy(alpha)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-5)
    assert float(alpha.grad[0, 1]) > 0.0 > float(alpha.grad[1, 0])
    sure = torch.tensor([[0.0, 1.0]], requires_grad=True)
    loss = mean_entropy(sure)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0.0, abs=2e-3) and torch.isfinite(sure.grad).all()


def test_a_masked_difference_is_the_mean_over_the_mask_and_0_without_pixels():
    image, target = random_image(11).requires_grad_(), random_image(12)
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    loss = masked_l1(image, target, mask)
    loss.backward()
    assert float(loss.detach()) == 0.0 and not image.grad.any()
    mask[2:5, 3:9] = True
    expected = (image.detach() - target)[mask].abs().mean()
    torch.testing.assert_close(masked_l1(image, target, mask).detach(), expected)


def test_classes_cost_the_logarithm_of_their_softmax_where_they_are_labelled():
    rng = np.random.default_rng(13)
    logits, classes = rng.normal(size=(4, 5, 3)), rng.integers(0, 3, (4, 5))
    classes[1, 2:], classes[3, 0] = 255, 255
    shares = np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)
    labelled = classes != 255
    expected = -np.mean(np.log(np.take_along_axis(shares, classes.clip(max=2)[..., None], axis=-1)[..., 0])[labelled])
    given = torch.from_numpy(logits).float().requires_grad_()
    found = class_cross_entropy(given, torch.from_numpy(classes.astype(np.uint8)))
    assert float(found.detach()) == pytest.approx(expected, rel=1e-5)
    nothing = class_cross_entropy(given, torch.full((4, 5), 255, dtype=torch.uint8))
    nothing.backward()
    assert float(nothing.detach()) == 0.0 and not given.grad.any()


def test_gaussians_learn_the_classes_of_their_pixels():
    """Two Gaussians side by side, the left half of the image of class 1, the right half of class 2 of three."""
    rng, settings = np.random.default_rng(14), GaussianSettings(init_opacity=0.9, init_scale=1.0)
    places = np.array([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]])
    part = Background.from_points(places, rng.uniform(size=(2, 3)), settings, 1.0, classes=3)
    with torch.no_grad():
        part.params["scales"].fill_(math.log(0.2))
    model = SplatModel([part], None)
    view = View(torch.tensor([[12.0, 0, 10], [0, 12, 7], [0, 0, 1]]), torch.eye(4), WIDTH, HEIGHT, 0.0)
    classes = torch.full((HEIGHT, WIDTH), 1, dtype=torch.uint8)
    classes[:, WIDTH // 2 :] = 2
    labelled_view = dataclasses.replace(
        a_view((random_image(1) * 255).to(torch.uint8), None), view=view, classes=classes
    )
    for weight in (0.5, 1.5):
        picture = model.render(view)
        terms = loss_terms(picture, labelled_view, model, TrainSettings(semantic_weight=weight))
        assert float(terms["semantic"].detach()) == pytest.approx(weight * math.log(3.0)), "nothing is known as yet"
    terms["semantic"].backward()
    pulls = -part.params["classes"].grad
    assert pulls.argmax(dim=1).tolist() == [1, 2] and (pulls[:, 0] < 0).all()
    assert "semantic" not in loss_terms(
        picture, dataclasses.replace(labelled_view, classes=None), model, TrainSettings()
    )
    assert "semantic" not in loss_terms(picture, labelled_view, a_model(), TrainSettings())


def street() -> tuple[SplatModel, Picture, TrainingView]:
    """A picture of background and two actors, one of them absent, by a view of which all is known."""
    there = track_of(motion_through([0.0, 0.5, 1.0], [[0.0, 0.0, 0.0]] * 3, 0.3), "there", (1.0, 1.0, 1.0))
    later = track_of(motion_through([3.0, 3.5, 4.0], [[0.0, 0.0, 0.0]] * 3), "later", (1.0, 1.0, 1.0))
    background = a_model(gaussians=8).parts[0]
    model = SplatModel([background, actors_of(there, later)], ConstantSky(torch.full((3,), 0.5), 1e-2))
    view = looking_at([0.0, 0.0, 0.0], [0.0, -3.0, 0.5], time=0.5, width=WIDTH, height=HEIGHT)
    moving, (_, lidar, _) = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool), a_lidar(40)
    moving[4:9, 6:14] = True
    _, seen = a_case(model)
    recorded = dataclasses.replace(seen, view=view, moving=moving, lidar=lidar)
    return model, model.render(view, with_depth=True), recorded


def test_terms_are_what_they_are_called():
    model, picture, view = street()
    settings = TrainSettings(sky_bce_weight=0.3, depth_weight=0.4, entropy_weight=0.5, dynamic_weight=0.6)
    terms = loss_terms(picture, view, model, settings)
    alone, penalties = SplatModel([model.parts[1]], None).render(view.view).alpha, model.parts[1].penalties()
    assert penalties.keys() == {"track_size", "track_bend"}
    expected = {
        "sky_bce": 0.3 * mean_cross_entropy(picture.alpha, view.sky),
        "depth": 0.4 * depth_loss(picture.depth, view.lidar),
        "entropy": 0.5 * mean_entropy(alone),
        "dynamic": 0.6 * masked_l1(picture.image, view.target(), view.moving),
        **penalties,
    }
    assert terms.keys() == {"l1", "ssim", "opacity_reg", "scale_reg", "sky_alpha", *expected}
    torch.testing.assert_close({name: terms[name] for name in expected}, expected)
    assert all(float(term.detach()) > 0.0 for term in terms.values())


def test_penalties_of_several_parts_add_up():
    """Vehicles and people both have tracks whose corrections are penalised."""
    model, picture, view = street()
    standing = motion_through([0.0, 0.5, 1.0], [[0.0, 0.0, 2.0]] * 3)
    other = actors_of(track_of(standing, "other", (1.0, 1.0, 1.0)), seed=1)
    both = SplatModel([*model.parts, other], model.sky)
    shown = dataclasses.replace(picture, sets=GaussianSets(both.sample(both.states(0.0))))
    terms = loss_terms(shown, view, both, TrainSettings())
    for name, penalty in model.parts[1].penalties().items():
        torch.testing.assert_close(terms[name], penalty + other.penalties()[name])
        assert float(penalty.detach()) > 0.0 and float(other.penalties()[name].detach()) > 0.0


def test_a_static_model_has_no_terms_of_dynamic_parts():
    _, _, view = street()
    model = SplatModel([a_model().parts[0]], None)
    picture = model.render(view.view)
    unguided = dataclasses.replace(view, sky=None, moving=None, lidar=None)
    everything = TrainSettings(sky_bce_weight=1.0, depth_weight=1.0, entropy_weight=1.0, dynamic_weight=1.0)
    assert loss_terms(picture, unguided, model, everything).keys() == {"l1", "ssim", "opacity_reg", "scale_reg"}


@pytest.mark.parametrize(("term", "parameter"), [("opacity_reg", "opacities"), ("scale_reg", "scales")])
def test_a_regularizer_makes_its_parameter_smaller_and_no_other_but_not_what_is_absent(term, parameter):
    """Nothing in the picture could hold against it: an actor would fade while it is away."""
    model, picture, view = street()
    loss_terms(picture, view, model, TrainSettings())[term].backward()
    still, actors = (part.params for part in model.parts)
    there = actors["owner"] == 0
    assert (still[parameter].grad > 0).all() and (actors[parameter].grad[there] > 0).all()
    assert not actors[parameter].grad[~there].any()
    others = [value.grad for part in (still, actors) for name, value in part.items() if name != parameter]
    assert not any(gradient is not None and gradient.any() for gradient in others)


@pytest.mark.parametrize("hidden", [False, True])
def test_entropy_has_gradients_for_actors_only_and_not_behind_the_ego_mask(hidden):
    """The ego vehicle's body fills the image."""
    model, picture, view = street()
    body = torch.full((HEIGHT, WIDTH), hidden)
    term = loss_terms(picture, dataclasses.replace(view, ego_mask=body), model, TrainSettings())["entropy"]
    term.backward()
    still, actors = (part.params for part in model.parts)
    assert all(value.grad is None or not value.grad.any() for value in still.values())
    assert bool(actors["opacities"].grad[actors["owner"] == 0].any()) != hidden
    assert not hidden or float(term.detach()) == pytest.approx(0.0, abs=2e-4)


# ---- what the ego vehicle hides


def beneath(seen: TrainingView) -> TrainingView:
    """A view at whose lower left the ego vehicle's body is seen and masked."""
    ego_mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    ego_mask[9:, :12] = True
    columns, rows = seen.lidar.pixels % WIDTH, seen.lidar.pixels // WIDTH
    clear = ~ego_mask[rows, columns]
    lidar = LidarDepth(seen.lidar.pixels[clear], seen.lidar.depth[clear])
    classes = torch.where(ego_mask, 255, torch.randint(0, 3, (HEIGHT, WIDTH), generator=torch.manual_seed(0)))
    return dataclasses.replace(
        seen,
        ego_mask=ego_mask,
        sky=seen.sky & ~ego_mask,
        moving=seen.moving & ~ego_mask,
        lidar=lidar,
        classes=classes.to(torch.uint8),
    )


def by_night(seen: TrainingView) -> TrainingView:
    """The view without sky mask, and with pixels below the horizon, of which the ego vehicle hides some."""
    below = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    below[6:] = True
    return dataclasses.replace(seen, sky=None, not_sky=below)


EVERYTHING = TrainSettings(
    sky_alpha_weight=0.3, sky_bce_weight=0.3, depth_weight=0.3, entropy_weight=0.3, dynamic_weight=0.3,
    horizon_weight=0.3, semantic_weight=0.3, gaussians=GaussianSettings(init_opacity=0.6),
)  # fmt: skip


def image_terms(picture: Picture, view: TrainingView, model: SplatModel) -> dict[str, torch.Tensor]:
    """The terms that ask something of pixels."""
    terms = loss_terms(picture, view, model, EVERYTHING)
    return {name: term for name, term in terms.items() if not name.endswith("_reg") and not name.startswith("track")}


@pytest.mark.parametrize("night", [False, True])
def test_pixels_of_the_ego_mask_change_no_term_and_get_no_gradient(night):
    """Colours, opacities and depths of its pixels; those of all others get the gradients of the picture with the
    recorded body in its place."""
    model, picture, seen = street()
    view = by_night(beneath(seen)) if night else beneath(seen)
    hidden = {
        "image": torch.where(view.ego_mask[..., None], 0.1, picture.image),
        "alpha": torch.where(view.ego_mask, 0.4, picture.alpha),
        "depth": torch.where(view.ego_mask, 90.0, picture.depth),
    }
    leaves = {name: values.detach().clone().requires_grad_() for name, values in hidden.items()}
    changed = dataclasses.replace(picture, **leaves)
    before, after = (image_terms(shown, view, model) for shown in (picture, changed))
    of_sky = {"horizon"} if night else {"sky_alpha", "sky_bce"}
    assert before.keys() == after.keys() == of_sky | {"l1", "ssim", "depth", "entropy", "dynamic"}
    for name, term in before.items():
        assert torch.equal(term, after[name]), name
    plain = dataclasses.replace(view, ego_mask=None)
    assert not torch.equal(*(image_terms(shown, plain, model)["ssim"] for shown in (picture, changed)))
    sum(term for name, term in after.items() if name != "entropy").backward()
    for name, leaf in leaves.items():
        assert leaf.grad.abs().sum() > 0.0, name
        assert not leaf.grad[view.ego_mask].any(), name
    beside = torch.zeros_like(view.ego_mask)
    beside[7:9, :12] = True
    assert leaves["image"].grad[beside].abs().min() > 0.0, "what is seen beside the body still counts"
