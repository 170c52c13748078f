"""Cameras, Gaussians from seed points, composition over a sky, and a model saved and rebuilt."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from drivesplat.images import pixel_rays
from drivesplat.model.background import Background
from drivesplat.model.build import Beginnings, build_model, definitions, gaussian_cap, rebuild_model
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.part import Part
from drivesplat.model.sky import ConstantSky, CubemapSky
from drivesplat.model.splat_model import SplatModel, View
from drivesplat.settings.gaussians import GaussianSettings
from drivesplat.settings.train import TrainSettings

SH_C0 = 0.5 / np.sqrt(np.pi)
SKY_COLOR = np.array([0.2, 0.4, 0.8])


def a_view(width: int = 24, height: int = 16) -> View:
    """A camera turned and moved, with its principal point off the middle."""
    camera_to_world = torch.eye(4)
    camera_to_world[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [0.1, -0.2, 0.05]).as_matrix())
    camera_to_world[:3, 3] = torch.tensor([0.4, -0.3, -1.0])
    intrinsics = torch.tensor([[20.0, 0.0, 11.3], [0.0, 22.0, 8.9], [0.0, 0.0, 1.0]])
    return View(intrinsics, camera_to_world, width, height, time=0.5)


def seed_points(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Positions before the camera of `a_view`, and colours in [0, 1]."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-2, -1.5, 2], [2, 1.5, 6], (count, 3)), rng.uniform(0, 1, (count, 3))


def parser_record(count: int) -> dict[str, Any]:
    positions, colors = seed_points(count)
    return {
        "points": positions.astype(np.float32),
        "points_rgb": (colors * 255).astype(np.uint8),
        "scene_scale": 3.0,
        "image_sizes": np.array([[100, 50], [100, 50], [40, 30]]),
        "splits": {"train": np.array([0, 2]), "interpolation": np.array([1])},
    }


def beginnings(parser: dict[str, Any], *actors: dict[str, Any]) -> Beginnings:
    return Beginnings(parser, list(actors), SKY_COLOR)


def shaken(model: nn.Module) -> nn.Module:
    """The model with every parameter moved, as after a training."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for value in model.parameters():
            value += 0.2 * torch.randn(value.shape, generator=generator)
    return model


def test_rays_of_a_view_are_those_of_its_pixels():
    view = a_view()
    expected = pixel_rays((view.width, view.height), view.K.double().numpy(), view.camera_to_world.double().numpy())
    np.testing.assert_allclose(view.rays().numpy(), expected, atol=1e-6)


def test_a_gaussian_shows_where_its_ray_points():
    """Rays and rasterizer share one pixel convention."""
    view = a_view()
    row, column = 5, 17
    at = view.camera_to_world[:3, 3] + 4.0 * view.rays()[row, column]
    params = Background.from_points(
        at[None].numpy(), np.ones((1, 3)), GaussianSettings(sh_degree=0, init_opacity=0.5), 1.0
    ).params
    params["scales"].data.fill_(np.log(0.02))
    alpha = SplatModel([Background(dict(params), GaussianSettings(), 1.0)], None).render(view, 0).alpha.detach()
    assert torch.equal((alpha == alpha.max()).nonzero(), torch.tensor([[row, column]]))
    assert float(alpha.max()) == pytest.approx(0.5, abs=1e-4)


def test_viewmat_undoes_camera_to_world():
    view = a_view()
    torch.testing.assert_close(view.viewmat @ view.camera_to_world, torch.eye(4), atol=1e-6, rtol=0)


def test_seed_gaussians_have_the_points_places_and_colours():
    positions, colors = seed_points(50)
    gaussians = Background.from_points(positions, colors, GaussianSettings(sh_degree=2), 1.0).at(0.0)
    np.testing.assert_allclose(gaussians.means.detach(), positions, atol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * gaussians.sh[:, 0].detach(), colors, atol=1e-6)
    assert gaussians.sh.shape == (50, 9, 3) and (gaussians.sh[:, 1:] == 0).all()


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.9])
def test_seed_gaussians_have_the_opacity_set(opacity):
    settings = GaussianSettings(init_opacity=opacity)
    opacities = Background.from_points(*seed_points(10), settings, 1.0).at(0.0).opacities
    torch.testing.assert_close(opacities.detach(), torch.full((10,), opacity))


@pytest.mark.parametrize("factor", [1.0, 0.3])
def test_seed_gaussians_are_round_and_as_large_as_their_neighbours_are_far(factor):
    positions, colors = seed_points(60)
    gaussians = Background.from_points(positions, colors, GaussianSettings(init_scale=factor), 1.0).at(0.0)
    distances = np.sort(np.linalg.norm(positions[:, None] - positions[None], axis=-1), axis=1)[:, 1:4]
    expected = factor * np.sqrt((distances**2).mean(axis=1))
    np.testing.assert_allclose(gaussians.scales.detach(), expected[:, None].repeat(3, axis=1), rtol=1e-5)
    np.testing.assert_array_equal(gaussians.quats.detach(), np.tile([1.0, 0.0, 0.0, 0.0], (60, 1)))


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_points_are_gaussians_too(count):
    positions = np.arange(3.0 * count).reshape(count, 3)
    gaussians = Background.from_points(positions, np.full((count, 3), 0.5), GaussianSettings(), 1.0).at(0.0)
    assert len(gaussians) == count
    assert torch.isfinite(gaussians.scales).all() and (gaussians.scales > 0).all()


def test_points_at_one_place_have_a_size():
    gaussians = Background.from_points(np.ones((5, 3)), np.full((5, 3), 0.5), GaussianSettings(), 1.0).at(0.0)
    assert torch.isfinite(torch.log(gaussians.scales)).all()


def test_positions_learn_in_proportion_to_the_scene():
    rates = Background.from_points(*seed_points(5), GaussianSettings(lr_means=1e-4), 7.0).learning_rates()
    assert rates["means"] == pytest.approx(7e-4)
    assert rates.keys() == {"means", "scales", "quats", "opacities", "sh0", "shN"}


@pytest.mark.parametrize("sky", [ConstantSky, CubemapSky])
def test_the_sky_shows_through_what_the_gaussians_leave(sky):
    part = Background.from_points(*seed_points(40), GaussianSettings(init_scale=0.3, init_opacity=0.5), 1.0)
    color = torch.tensor([0.3, 0.6, 0.9])
    behind = sky(color, 1e-2) if sky is ConstantSky else shaken(sky(4, color, 1e-2))
    view = a_view()
    with torch.no_grad():
        without = SplatModel([part], None).render(view, 0)
        picture = SplatModel([part], behind).render(view, 0, with_depth=True)
    assert float(without.alpha.max()) > 0.5 and float(without.alpha.min()) < 0.1
    expected = without.image + (1.0 - without.alpha)[..., None] * behind.colors(view.rays())
    torch.testing.assert_close(picture.image, expected)
    torch.testing.assert_close(picture.alpha, without.alpha)
    assert picture.depth.shape == picture.alpha.shape and without.depth is None


def test_given_rays_stand_in_for_the_views_own():
    model = SplatModel([Background.from_points(*seed_points(10), GaussianSettings(), 1.0)], shaken_cubemap())
    view = a_view()
    torch.testing.assert_close(model.render(view, 0, rays=view.rays()).image, model.render(view, 0).image)
    mirrored = model.render(view, 0, rays=-view.rays()).image
    assert not torch.allclose(mirrored, model.render(view, 0).image)


def shaken_cubemap() -> CubemapSky:
    return shaken(CubemapSky(4, torch.full((3,), 0.5), 1e-2))


class Riding(Part):
    """Gaussians that move along x at one metre a second."""

    name = "riding"

    def __init__(self, still: Background):
        super().__init__()
        self.params = still.params
        self._still = still

    def at(self, time: float) -> Gaussians:
        still = self._still.at(time)
        shift = torch.tensor([time, 0.0, 0.0])
        return Gaussians(still.means + shift, still.quats, still.scales, still.opacities, still.sh)

    def learning_rates(self) -> dict[str, float]:
        return self._still.learning_rates()

    def definition(self) -> dict[str, Any]:
        return {}


def test_a_model_shows_all_its_parts_at_the_views_time():
    first = Background.from_points(*seed_points(20, seed=1), GaussianSettings(), 1.0)
    second = Background.from_points(*seed_points(15, seed=2), GaussianSettings(), 1.0)
    moved = {name: value.detach().clone() for name, value in second.params.items()}
    moved["means"][:, 0] += a_view().time
    both = {name: torch.cat([first.params[name].detach(), moved[name]]) for name in moved}
    model = SplatModel([first, Riding(second)], None)
    expected = SplatModel([Background(both, GaussianSettings(), 1.0)], None).render(a_view(), 0)
    assert len(model) == 35
    torch.testing.assert_close(model.render(a_view(), 0).image, expected.image)


def test_concatenate_keeps_order_and_every_field():
    a, b = (Background.from_points(*seed_points(n, seed=n), GaussianSettings(sh_degree=1), 1.0).at(0.0) for n in (3, 4))
    joined = concatenate([a, b])
    assert len(joined) == 7
    for field in fields(Gaussians):
        torch.testing.assert_close(getattr(joined, field.name)[:3], getattr(a, field.name))
        torch.testing.assert_close(getattr(joined, field.name)[3:], getattr(b, field.name))


def test_concatenating_one_set_copies_nothing():
    one = Background.from_points(*seed_points(3), GaussianSettings(), 1.0).at(0.0)
    assert concatenate([one]) is one


@pytest.mark.parametrize("sh_degree", [0, 2])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sky", ["none", "mask", "cubemap"])
def test_a_model_rebuilt_from_its_state_renders_the_same(sky, antialiased, sh_degree):
    settings = TrainSettings(
        antialiased=antialiased, sky_resolution=4, gaussians=GaussianSettings(sh_degree=sh_degree, init_scale=0.5)
    )
    model = shaken(build_model(beginnings(parser_record(40)), ("background",), sky, settings))
    rebuilt = rebuild_model(model.state_dict(), definitions(model), sky, settings)
    picture, again = (m.render(a_view(), sh_degree, with_depth=True) for m in (model, rebuilt))
    assert float(picture.alpha.detach().max()) > 0.3
    assert torch.equal(again.image, picture.image) and torch.equal(again.depth, picture.depth)
    assert rebuilt.parts[0].learning_rates() == model.parts[0].learning_rates()


@pytest.mark.parametrize(("sky", "kind"), [("none", type(None)), ("mask", ConstantSky), ("cubemap", CubemapSky)])
def test_the_sky_setting_names_the_sky(sky, kind):
    model = build_model(beginnings(parser_record(5)), ("background",), sky, TrainSettings(sky_resolution=4))
    assert isinstance(model.sky, kind)
    if model.sky is not None:
        np.testing.assert_allclose(model.sky.colors(a_view().rays())[3, 4].detach(), SKY_COLOR, atol=1e-5)


def test_a_model_starts_with_no_more_points_than_its_cap():
    record = parser_record(300)
    model = build_model(beginnings(record), ("background",), "none", TrainSettings(cap_max=120))
    means = model.parts[0].params["means"].detach().numpy()
    assert len(model) == 120
    rows = {tuple(row) for row in record["points"]}
    assert len({tuple(row) for row in means} & rows) == 120


@pytest.mark.parametrize(
    ("cap_max", "pixels_per_gaussian", "expected"),
    [
        pytest.param(1000, 20.0, 310, id="the training pixels decide: (100 x 50 + 40 x 30) / 20"),
        pytest.param(200, 20.0, 200, id="cap_max decides"),
        pytest.param(1000, 0.0, 1000, id="no limit by pixels"),
        pytest.param(1000, 1e6, 1, id="never less than one"),
    ],
)
def test_gaussians_are_capped_by_the_training_pixels(cap_max, pixels_per_gaussian, expected):
    settings = TrainSettings(cap_max=cap_max, pixels_per_gaussian=pixels_per_gaussian)
    assert gaussian_cap(parser_record(5), settings) == expected
