"""Gaussians in the surface of a road: the surface, where they are on it, gradients, checkpoint, and a fit."""

import dataclasses

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers.hand_made import looking_at, round_gaussians
from helpers.records import training_record_of
from helpers.samples import EVERYTHING, sampled

from drivesplat.kernels.quaternions import rotation_matrix
from drivesplat.model.build import ModelInit, build_model, definitions, rebuild_model
from drivesplat.model.height_field import HeightField
from drivesplat.model.road import ABOVE, EDGE, LARGEST, THICKNESS, RoadPart, RoadSeed
from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.train import GaussianSettings, TrainSettings
from drivesplat.training.floaters import EmptySpace, fade_in_empty_space
from drivesplat.training.loop import Trainer
from drivesplat.training.resume_state import restore_model
from drivesplat.training.views import TrainingView

SLOPE = np.array([0.2, -0.1])
SIZE = 8
LOWER = np.array([-2.0, -2.0])


def plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 1.0 + SLOPE[0] * x + SLOPE[1] * y


def a_surface(uncovered: tuple[int, int] | None = None) -> HeightField:
    """A sloping plane on 8 x 8 cells, but for one cell known everywhere."""
    x, y = np.meshgrid(*(LOWER[:, None] + EDGE * np.arange(SIZE + 1)), indexing="ij")
    covered = torch.ones(SIZE, SIZE, dtype=torch.bool)
    if uncovered:
        covered[uncovered] = False
    return HeightField(torch.from_numpy(LOWER).float(), EDGE, torch.from_numpy(plane(x, y)).float(), covered)


def a_seed(count: int = 30, surface: HeightField | None = None) -> RoadSeed:
    random = np.random.default_rng(0)
    places = random.uniform(-1.9, 1.9, (count, 2))
    positions = np.column_stack([places, plane(*places.T)])
    return RoadSeed(surface or a_surface(), positions, np.full(count, 0.3), random.uniform(0, 1, (count, 3)))


def a_road(count: int = 30, surface: HeightField | None = None, **more: object) -> RoadPart:
    """Gaussians of any extent and rotation."""
    part = RoadPart.from_seed(a_seed(count, surface), GaussianSettings(), 5.0, **more)
    generator = torch.Generator().manual_seed(1)
    for name in ("quats", "scales", "opacities"):
        value = part.params[name].data
        value += 0.5 * torch.randn(value.shape, generator=generator)
    return part


# ---- the surface


def test_heights_between_nodes_are_bilinear():
    random = np.random.default_rng(0)
    nodes = torch.from_numpy(random.normal(size=(4, 5)))
    field = HeightField(torch.tensor([1.0, -2.0]).double(), 0.5, nodes, torch.ones(3, 4, dtype=torch.bool))
    places = torch.tensor([[1.0, -2.0], [1.5, -1.5], [2.2, -0.3]], dtype=torch.float64)
    heights = field.at(places)
    u, v = (2.2 - 2.0) / 0.5, (-0.3 + 0.5) / 0.5
    expected = (1 - u) * ((1 - v) * nodes[2, 3] + v * nodes[2, 4]) + u * ((1 - v) * nodes[3, 3] + v * nodes[3, 4])
    torch.testing.assert_close(heights, torch.stack([nodes[0, 0], nodes[1, 1], expected]))
    between = torch.tensor([[1.1, -1.9], [2.2, -0.3]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(field.at, between)


def test_heights_have_a_gradient_for_the_nodes_around():
    nodes = torch.zeros(3, 3, dtype=torch.float64, requires_grad=True)
    covered = torch.ones(2, 2, dtype=torch.bool)
    place = torch.tensor([[0.25, 0.75]]).double()
    assert torch.autograd.gradcheck(
        lambda values: HeightField(torch.zeros(2).double(), 0.5, values, covered).at(place), nodes
    )


def test_a_surface_is_known_in_covered_cells_alone_and_continues_beyond_them():
    field = a_surface(uncovered=(1, 2))
    places = torch.tensor([[0.1, 0.1], [-1.3, -0.8], [-1.3, -0.4], [2.1, 0.0], [0.0, -2.3], [9.0, 9.0]])
    assert field.covers(places).tolist() == [True, False, True, False, False, False]
    expected = torch.from_numpy(plane(*places.double().numpy().T)).float()
    torch.testing.assert_close(field.at(places), expected)


def test_a_layer_is_the_space_near_a_known_surface():
    over = torch.tensor([-0.31, -0.29, 0.0, 0.09, 0.11])
    points = torch.stack([over * 0 + 0.3, over * 0 - 0.2, plane(0.3, -0.2) + over], dim=1)
    assert a_surface().layer(points, 0.3, 0.1).tolist() == [False, True, True, True, False]
    assert not a_surface(uncovered=(4, 3)).layer(points, 0.3, 0.1).any()


# ---- Gaussians on it


def test_gaussians_lie_flat_in_the_surface_whatever_their_parameters():
    part = a_road()
    part.params["means"].data[:, 2] = 77.0
    found = sampled(part, 0.0)
    x, y, z = found.means.detach().double().numpy().T
    np.testing.assert_allclose(z, plane(x, y), atol=1e-6)
    np.testing.assert_array_equal(np.column_stack([x, y]), part.params["means"].detach()[:, :2].numpy())
    axes = rotation_matrix(F.normalize(found.quats.detach(), dim=1))
    normal = F.normalize(torch.tensor([-SLOPE[0], -SLOPE[1], 1.0]), dim=0).float()
    torch.testing.assert_close(axes[:, :, 2], normal.expand(30, 3), atol=1e-6, rtol=0)
    assert (found.scales[:, 2] == THICKNESS).all()
    torch.testing.assert_close(found.scales[:, :2], part.params["scales"][:, :2].exp().clamp(max=LARGEST))


def test_gaussians_turn_about_the_normal():
    flat, angles = a_surface(), torch.tensor([0.0, 0.7, -2.0])
    flat.heights.zero_()
    part = a_road(3, flat)
    nothing = torch.zeros(3)
    part.params["quats"].data = torch.stack([torch.cos(angles / 2), nothing, nothing, torch.sin(angles / 2)], dim=1)
    axes = rotation_matrix(F.normalize(sampled(part, 0.0).quats.detach(), dim=1))
    torch.testing.assert_close(torch.atan2(axes[:, 1, 0], axes[:, 0, 0]), angles)


def test_what_cannot_be_learned_has_no_gradient_for_it():
    part = a_road(lidar_logits=(0.3, 0.9), classes=3)
    found = sampled(part, 0.0, EVERYTHING)
    assert found.lidar_logits is part.params["lidar_logits"] and found.velocities is None
    part.zero_grad()
    (found.means.sum() + found.quats.sum() + found.scales.square().sum() + found.opacities.sum()).backward()
    assert {name for name, value in part.params.items() if value.grad is not None} == set(part.geometry)
    assert not part.params["means"].grad[:, 2].any() and not part.params["scales"].grad[:, 2].any()
    assert not part.params["quats"].grad[:, 1:3].any() and part.params["quats"].grad[:, 3].any()


def test_gaussians_outside_of_what_is_covered_fade_and_the_others_are_put_onto_the_surface():
    part = a_road(3, a_surface(uncovered=(1, 2)))
    part.params["means"].data = torch.tensor([[0.1, 0.1, 5.0], [-1.3, -0.8, 5.0], [9.0, 9.0, 5.0]])
    part.confine()
    assert (torch.sigmoid(part.params["opacities"]) < 1e-3).tolist() == [False, True, True]
    torch.testing.assert_close(part.params["means"].data[0, 2], torch.tensor(plane(0.1, 0.1)).float())


def test_gaps_get_opaque_copies_of_the_nearest_gaussians():
    """None are in the cells with x above 0, of which one is not covered."""
    part = RoadPart.from_seed(a_seed(400, a_surface(uncovered=(6, 6))), GaussianSettings(), 5.0)
    part.params["opacities"].data.fill_(2.0)
    left = part.params["means"][:, 0] < 0.0
    part.params = torch.nn.ParameterDict({name: values.detach()[left] for name, values in part.params.items()})
    count, fillers = len(part), part.gap_fillers()
    x, y, z = fillers["means"].double().numpy().T
    right = (x > 0.0).sum()
    assert right >= 4 * (SIZE // 2 - 1) * SIZE - 4 and right > 0.85 * len(x)
    assert not ((x > 1.0) & (x < 1.5) & (y > 1.0) & (y < 1.5)).any()
    np.testing.assert_allclose(z, plane(x, y), atol=1e-6)
    means, colors = part.params["means"].detach(), part.params["sh0"].detach()
    nearest = torch.cdist(fillers["means"][:, :2], means[:, :2]).argmin(dim=1)
    torch.testing.assert_close(fillers["sh0"], colors[nearest])
    part.extend(fillers, count)
    assert len(part) == count + len(x) and all(len(values) == len(part) for values in part.params.values())
    assert (sampled(part, 0.0).opacities[count:] > 0.9).all() and len(part.gap_fillers()["means"]) == 0
    part.extend({name: values[:2] for name, values in fillers.items()}, count)
    assert len(part) == count + 2


def test_an_invisible_road_has_nothing_to_copy():
    part = a_road()
    part.params["opacities"].data.fill_(-5.0)
    assert len(part.gap_fillers()["means"]) == 0


def test_other_static_gaussians_fade_near_the_surface_and_those_of_the_road_do_not():
    road = a_road()
    over = [-0.2, 0.05, ABOVE + 0.05]
    others = round_gaussians([[0.1, 0.1, plane(0.1, 0.1) + it] for it in over])
    fade_in_empty_space([others, road], EmptySpace(road_part=road))
    assert (torch.sigmoid(others.params["opacities"]) < 1e-3).tolist() == [True, True, False]
    assert (torch.sigmoid(road.params["opacities"]) > 0.01).all()
    assert EmptySpace(road_part=road).known


# ---- in a model


def an_untrained_model(seed: RoadSeed | None) -> SplatModel:
    init = ModelInit(training_record_of(2), [], np.full(3, 0.5), road=seed)
    return build_model(init, ("background", "road"), "none", TrainSettings())


def test_a_model_has_a_road_where_its_surface_is_known_and_is_rebuilt_with_it():
    assert [part.name for part in an_untrained_model(None).parts] == ["background"]
    model = an_untrained_model(a_seed())
    assert [part.name for part in model.parts] == ["background", "road"]
    road = model.parts[1]
    assert isinstance(road, RoadPart) and not road.moves and not road.has_objects and road.cap_max == 30
    state = {name: value.clone() for name, value in model.state_dict().items()}
    again = rebuild_model(state, definitions(model), "none", TrainSettings())
    mine, theirs = (it.at(0.0).tensors for it in (model, again))
    assert mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)
    assert torch.equal(again.parts[1].covered, road.covered)


def test_a_training_resumes_with_its_surface():
    model, other = an_untrained_model(a_seed()), an_untrained_model(a_seed())
    model.parts[1].heights += 0.03
    model.parts[1].params["means"].data += 0.01
    restore_model(other, {name: value.detach().clone() for name, value in model.state_dict().items()})
    mine, theirs = model.at(0.0).tensors, other.at(0.0).tensors
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)


@pytest.mark.usefixtures("one_thread")
def test_paint_is_learned_from_afar_and_seen_from_aside():
    """A white stripe across a grey slope, seen along x by cameras that drive, and measured from 1.5 m aside."""
    surface = a_surface()
    random = np.random.default_rng(0)
    places = np.stack(np.meshgrid(*[np.arange(-1.9, 1.95, 0.12)] * 2), axis=-1).reshape(-1, 2)
    seed = RoadSeed(
        surface, np.column_stack([places, plane(*places.T)]), np.full(len(places), 0.12),
        np.full((len(places), 3), 0.5),
    )  # fmt: skip
    truth = RoadPart.from_seed(
        dataclasses.replace(seed, colors=np.where(np.abs(places[:, :1]) < 0.3, 0.9, 0.3).repeat(3, axis=1)),
        GaussianSettings(sh_degree=0), 4.0,
    )  # fmt: skip
    truth.params["opacities"].data.fill_(4.0)
    recorded = SplatModel([truth], None)

    def seen(start: float, aside: float) -> TrainingView:
        view = looking_at([start + 5.0, aside, 0.0], [start, aside, 2.0])
        image = recorded.render(view).image.detach().clamp(0.0, 1.0)
        return TrainingView(view, (255.0 * image).round().to(torch.uint8))

    settings = TrainSettings(iterations=80, opacity_reg=0, scale_reg=0, entropy_weight=0, sh_every=0)
    learned = RoadPart.from_seed(
        dataclasses.replace(seed, colors=random.uniform(0.4, 0.6, (len(places), 3))),
        GaussianSettings(sh_degree=0, lr_sh0=2e-2), 4.0,
    )  # fmt: skip
    model = SplatModel([learned], None)
    trainer = Trainer.begin(model, [seen(x, 0.0) for x in (-5.0, -4.5, -4.0)], settings, 0, torch.device("cpu"))
    aside = seen(-4.2, 1.5)
    errors = []
    for _ in range(2):
        with torch.no_grad():
            errors.append(float((model.render(aside.view).image - aside.pixels / 255.0).square().mean()))
        for _ in range(80 if len(errors) == 1 else 0):
            trainer.training_step()
            trainer.state.step += 1
    assert errors[1] < 0.15 * errors[0]
