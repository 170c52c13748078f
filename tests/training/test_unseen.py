"""What no training image shows gets the colours around it: texels of the sky, and Gaussians behind objects."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made import motion_through, track_of
from helpers.trainings import CPU, PROVENANCE, files_in, inputs_in, job_of

from drivesplat.model.actors import Actors
from drivesplat.model.background import Background
from drivesplat.model.checkpoint import read_checkpoint, trained_model
from drivesplat.model.height_field import HeightField
from drivesplat.model.part import Part
from drivesplat.model.road import EDGE, RoadPart, RoadSeed
from drivesplat.model.sky import ConstantSky, CubemapSky, logit_of
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import ActorSettings
from drivesplat.training.stage import run_training
from drivesplat.training.unseen import fill_unseen
from drivesplat.training.views import TrainingView

pytestmark = pytest.mark.usefixtures("one_thread")
WIDTH, HEIGHT = 64, 48
RED, BLUE = (0.8, 0.1, 0.1), (0.2, 0.3, 0.9)


def a_view(
    moving: torch.Tensor | None = None, ego: torch.Tensor | None = None, device: torch.device = CPU
) -> TrainingView:
    """A camera at the origin that looks along z, 45 degrees to both sides; x is to the right, y down."""
    intrinsics = torch.tensor([[32.0, 0.0, 32.0], [0.0, 32.0, 24.0], [0.0, 0.0, 1.0]], device=device)
    view = View(intrinsics, torch.eye(4, device=device), WIDTH, HEIGHT, time=0.0)
    black = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8, device=device)
    return TrainingView(view, black, moving=moving, ego_mask=ego)


def grid(x: tuple[float, float], y: tuple[float, float], z: float, step: float) -> np.ndarray:
    """Points (n, 3) of a plate across the view."""
    columns, rows = np.meshgrid(np.arange(*x, step), np.arange(*y, step))
    return np.stack([columns, rows, np.full_like(columns, z)], axis=-1).reshape(-1, 3)


def opaque(points: np.ndarray, color: tuple[float, float, float], size: float, sh_degree: int = 1) -> Background:
    settings = GaussianSettings(sh_degree=sh_degree)
    return made_opaque(Background.from_points(points, np.tile(color, (len(points), 1)), settings, 1.0), size)


def made_opaque(part: Part, size: float) -> Part:
    part.params["opacities"].data.fill_(8.0)
    part.params["scales"].data.fill_(float(np.log(size)))
    return part


def beside_a_wall(color: tuple[float, float, float] = RED) -> SplatModel:
    """An opaque wall 2 m ahead on the left side of the image, and blue sky with noise of other colours behind it and
    where the camera does not look."""
    wall = opaque(grid((-5.0, -0.1), (-4.0, 4.0), 2.0, 0.1), color, 0.08, sh_degree=0)
    sky = CubemapSky(16, torch.tensor(BLUE), 1e-2)
    seen = seen_by_the_camera(sky)
    noise = torch.randn(len(seen), 3, generator=torch.Generator().manual_seed(0))
    sky.params["texels"].data[~seen] = noise[~seen]
    return SplatModel([wall], sky)


def at_pose(camera_to_world: torch.Tensor) -> TrainingView:
    """`a_view` from elsewhere."""
    return dataclasses.replace(a_view(), view=dataclasses.replace(a_view().view, camera_to_world=camera_to_world))


def seen_by_the_camera(sky: CubemapSky) -> torch.Tensor:
    """The texels that interpolate pixels to the right of the wall."""
    x, y, z = sky.directions().unbind(dim=1)
    return (z > 0.9) & (x > -0.1) & (y.abs() < 0.8)


def filled(model: SplatModel, *views: TrainingView) -> torch.Tensor:
    """The colours of the texels afterwards."""
    fill_unseen(model, list(views))
    return torch.sigmoid(model.sky.params["texels"]).detach()


def test_texels_behind_a_wall_get_its_colour_seen_ones_keep_theirs_and_others_get_the_nearest():
    model = beside_a_wall()
    before, x, y, z = torch.sigmoid(model.sky.params["texels"]).detach(), *model.sky.directions().unbind(dim=1)
    after = filled(model, a_view())
    behind, open_sky = (z > 0.99) & (x < -0.3) & (y.abs() < 0.6), (z > 0.99) & (x > 0.3) & (y.abs() < 0.6)
    assert behind.sum() > 20 and open_sky.sum() > 20
    assert torch.allclose(after[behind], torch.tensor(RED), atol=0.03)
    assert torch.allclose(after[open_sky], before[open_sky], atol=1e-6)
    assert torch.allclose(after[x < -0.99], torch.tensor(RED), atol=0.05)
    assert torch.allclose(after[x > 0.99], torch.tensor(BLUE), atol=0.05)


@pytest.mark.parametrize("mask", ["moving", "ego"])
def test_pixels_of_moving_objects_and_of_the_ego_vehicle_give_no_colour(mask):
    """All of the wall but its uppermost part is masked, where it is green and blue. Nothing else is green."""
    model = beside_a_wall()
    with torch.no_grad():
        low = model.parts[0].params["means"][:, 1] > -1.0
        model.parts[0].params["sh0"][low] *= -1.0
    rows = torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH)
    columns = torch.arange(WIDTH).expand(HEIGHT, WIDTH)
    view = a_view(**{mask: (rows > 6) & (columns < WIDTH // 2)})
    x, y, z = model.sky.directions().unbind(dim=1)
    behind = (z > 0.99) & (x < -0.5) & (y.abs() < 0.6)
    assert filled(beside_a_wall((0.2, 0.9, 0.9)), a_view())[behind, 1].min() > 0.8
    assert filled(model, view)[behind, 1].max() < 0.35


@pytest.mark.parametrize(("another", "expected"), [(False, BLUE), (True, RED)], ids=["in boxes only", "also outside"])
def test_sky_that_shows_only_in_boxes_of_moving_objects_gets_the_colours_around_it(another, expected):
    """What it has learned there is the colour of the objects."""
    model, boxes = beside_a_wall(), torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    boxes[12:36, 39:57] = True
    x, y, z = model.sky.directions().unbind(dim=1)
    inside = (z > 0.99) & ((x - 0.5).abs() < 0.12) & (y.abs() < 0.15)
    assert inside.sum() >= 4
    with torch.no_grad():
        model.sky.params["texels"][inside] = logit_of(torch.tensor(RED))
    views = [a_view(boxes), a_view()] if another else [a_view(boxes)]
    assert torch.allclose(filled(model, *views)[inside], torch.tensor(expected), atol=0.05)


def test_a_camera_gives_no_colour_to_the_direction_opposite_to_its_own():
    """Directions towards -x lie on the edge of what interpolation takes for the face +x."""
    model = beside_a_wall()
    turned = torch.tensor([[0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    x, y, z = model.sky.directions().unbind(dim=1)
    middle = (y.abs() < 0.5) & (z.abs() < 0.5)
    with torch.no_grad():
        model.sky.params["texels"][x < -0.99] = logit_of(torch.tensor(RED))
        model.sky.params["texels"][(x < -0.99) & middle] = logit_of(torch.tensor((0.1, 0.9, 0.1)))
    after = filled(model, at_pose(turned))
    assert after[(x < -0.99) & middle, 1].max() > 0.8
    assert after[(x > 0.99) & middle, 1].max() < 0.5


def test_of_many_images_one_that_sees_through_is_enough():
    """The wall hides the left from the first two cameras; the third one is 7 m to the left of its end."""
    model, shifted = beside_a_wall(), []
    for x in (0.0, -0.5, -12.0):
        pose = torch.eye(4)
        pose[0, 3] = x
        shifted.append(at_pose(pose))
    before, (x, y, z) = model.sky.params["texels"].detach().clone(), model.sky.directions().unbind(dim=1)
    fill_unseen(model, shifted)
    through = (z > 0.99) & (x.abs() < 0.8) & (y.abs() < 0.6)
    assert (model.sky.params["texels"][through] - before[through]).abs().max() < 0.35
    behind = z < -0.99
    assert (model.sky.params["texels"][behind] - before[behind]).std() > 0.5, "they were noise"


def behind_a_van() -> tuple[SplatModel, torch.Tensor]:
    """A red wall 4 m ahead and an opaque blue plate 2 m ahead, which is an object and hides a quarter of the wall; what
    it hides is green, with harmonics. And the mask of Gaussians of the wall that are well inside the plate's shadow."""
    points, plate = grid((-4.0, 4.0), (-3.0, 3.0), 4.0, 0.1), grid((-1.0, 1.0), (-0.75, 0.75), 0.0, 0.05)
    van = track_of(motion_through([-1.0, 1.0], [[0.0, 0.0, 2.0]] * 2), size=(2.0, 1.5, 1.0))
    actors = Actors.from_points([van], [plate], [np.tile(BLUE, (len(plate), 1))], ActorSettings(), GaussianSettings())
    inside = torch.from_numpy((np.abs(points[:, 0]) < 1.4) & (np.abs(points[:, 1]) < 1.0))
    wall = opaque(points, RED, 0.08)
    wall.params["sh0"].data[inside] = torch.tensor([-1.5, 1.5, -1.5])
    wall.params["shN"].data[inside] = 0.3
    return SplatModel([wall, made_opaque(actors, 0.04)], None), inside


def test_static_gaussians_hidden_by_an_object_get_the_colour_around_them_unless_another_image_shows_them():
    """The second camera is 2.5 m to the left, and the van hides another part of the wall from it."""
    model, hidden = behind_a_van()
    wall, van = (part.params for part in model.parts)
    before, blue, pose = wall["sh0"].detach().clone(), van["sh0"].detach().clone(), torch.eye(4)
    pose[0, 3] = -2.5
    seen_from_there = hidden & (wall["means"][:, 0] < 0.0)
    fill_unseen(model, [a_view(), at_pose(pose)])
    assert torch.equal(wall["sh0"][seen_from_there], before[seen_from_there])
    fill_unseen(model, [a_view()])
    assert torch.allclose(wall["sh0"][hidden], before[0].expand_as(before[hidden]), atol=1e-4)
    assert not wall["shN"][hidden].any()
    assert torch.equal(wall["sh0"][~hidden], before[~hidden]) and torch.equal(van["sh0"], blue)


def test_gaps_of_a_road_are_filled_where_an_object_hides_them_in_all_images():
    """A surface 4 m ahead with a gap behind the van and one beside it."""
    model, _ = behind_a_van()
    points = grid((-4.0, 4.0), (-3.0, 3.0), 4.0, 0.1)
    hidden = (np.abs(points[:, 0]) < 1.0) & (np.abs(points[:, 1]) < 0.7)
    beside = (np.abs(points[:, 0] - 3.0) < 0.6) & (np.abs(points[:, 1]) < 0.6)
    points = points[~(hidden | beside)]
    surface = HeightField(
        torch.tensor([-4.0, -3.0]), EDGE, torch.full((17, 13), 4.0), torch.ones(16, 12, dtype=torch.bool)
    )
    seed = RoadSeed(surface, points, np.full(len(points), 0.1), np.tile(RED, (len(points), 1)))
    road = made_opaque(RoadPart.from_seed(seed, GaussianSettings(), 1.0), 0.08)
    fill_unseen(SplatModel([road, model.parts[1]], None), [a_view()])
    added = road.params["means"][len(points) :].detach()
    assert len(added) >= 8 and (added[:, :2].abs() < torch.tensor([1.3, 1.0])).all()
    torch.testing.assert_close(added[:, 2], torch.full((len(added),), 4.0))
    torch.testing.assert_close(road.params["sh0"][len(points) :], road.params["sh0"][:1].expand(len(added), 1, 3))
    alone = RoadPart.from_seed(seed, GaussianSettings(), 1.0)
    fill_unseen(SplatModel([alone], None), [a_view()])
    assert len(alone) == len(points), "without objects nothing hides it"


def test_what_stands_before_an_object_keeps_its_colour():
    model, _ = behind_a_van()
    pole = opaque(grid((0.0, 0.01), (-0.3, 0.3), 1.0, 0.05), (0.1, 0.9, 0.1), 0.03)
    before = pole.params["sh0"].detach().clone()
    fill_unseen(SplatModel([*model.parts, pole], None), [a_view()])
    assert torch.equal(pole.params["sh0"], before)


@pytest.mark.parametrize("nothing", ["is seen", "is an object"])
def test_where_nothing_is_seen_or_is_an_object_colours_are_kept(nothing):
    model = behind_a_van()[0] if nothing == "is seen" else beside_a_wall()
    body = torch.ones(HEIGHT, WIDTH, dtype=torch.bool) if nothing == "is seen" else None
    assert (model.parts[0].params["means"][:, 1].abs() > 2.8).any(), "there are Gaussians beside the image"
    before = model.parts[0].params["sh0"].detach().clone()
    fill_unseen(model, [a_view(ego=body)])
    assert torch.equal(model.parts[0].params["sh0"], before)


def test_pixels_of_the_ego_vehicle_show_no_gaussians():
    model, _ = behind_a_van()
    hood, wall = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool), model.parts[0].params
    hood[40:] = True
    below = wall["means"][:, 1] > 2.3
    with torch.no_grad():
        wall["sh0"][below] = torch.tensor([-1.5, 1.5, -1.5])
    fill_unseen(model, [a_view(ego=hood)])
    assert (wall["sh0"][below][:, 0, 1] < 0.0).all()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_on_a_gpu_texels_and_gaussians_get_the_same_colours():
    gpu, (expected, hidden), (model, _) = torch.device("cuda"), behind_a_van(), behind_a_van()
    fill_unseen(expected, [a_view()])
    fill_unseen(model.to(gpu), [a_view(device=gpu)])
    found = model.parts[0].params["sh0"].cpu()
    assert torch.allclose(found[hidden], expected.parts[0].params["sh0"][hidden], atol=1e-3)
    texels = filled(beside_a_wall().to(gpu), a_view(device=gpu)).cpu()
    assert torch.allclose(texels, filled(beside_a_wall(), a_view()), atol=5e-3)


def test_sky_behind_an_object_that_stands_does_not_get_its_colour():
    """Although no mask says that it moves, and many images show it."""
    model, _ = behind_a_van()
    model.sky = CubemapSky(32, torch.tensor(BLUE), 1e-2)
    x, y, z = model.sky.directions().unbind(dim=1)
    behind = (z > 0.99) & (x.abs() < 0.3) & (y.abs() < 0.2)
    after = filled(model, *[a_view()] * 25)
    assert torch.allclose(after[behind], torch.tensor(RED).expand_as(after[behind]), atol=0.1)


def test_without_a_cube_map_or_images_nothing_changes():
    model = beside_a_wall()
    before = model.sky.params["texels"].detach().clone()
    assert torch.equal(torch.sigmoid(before), filled(model))
    constant = SplatModel(list(model.parts), ConstantSky(torch.tensor(BLUE), 1e-2))
    fill_unseen(constant, [a_view()])
    assert torch.equal(constant.sky.params["color"], logit_of(torch.tensor(BLUE)))
    fill_unseen(SplatModel(list(model.parts), None), [a_view()])


def test_a_finished_training_has_a_filled_sky(tmp_path):
    """Training alone leaves what no image shows as it began."""
    files = files_in(tmp_path / "it")
    job = job_of(sky="cubemap", sky_resolution=8)
    run_training(inputs_in(tmp_path, actors=True), job, DeviceSettings(kind="cpu"), files, PROVENANCE, "train")
    sky = trained_model(read_checkpoint(files.checkpoint)).sky
    behind = sky.params["texels"][sky.directions()[:, 2] < -0.9]
    assert behind.std(dim=0).min() > 1e-3
