"""Views with a rolling shutter, rendered: the image that lines read one after the other make."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from helpers.hand_made import motion_through, round_gaussians, track_of
from helpers.samples import sampled
from scipy.spatial.transform import Rotation

from drivesplat.model.actors import Actors
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import RollingShutter, View, where_seen
from drivesplat.scene.shutter import Shutter
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import ActorSettings

WIDTH, HEIGHT, TIME = 64, 48, 1.0
VELOCITY = np.array([1.0, 0.0, 8.0, 0.02, 0.5, -0.1])
DOWN, RIGHT = (0.0, 0.06, 0.002), (0.06, 0.0, 0.0)


def view(readout: tuple[float, float, float] | None) -> View:
    """A camera that looks along the world's x axis and moves."""
    pose = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    K = torch.tensor([[50.0, 0.0, 31.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
    found = View(K, pose, WIDTH, HEIGHT, TIME)
    if readout is None:
        return found
    shutter = Shutter(np.array(readout), VELOCITY)
    tensors = (torch.from_numpy(values).float() for values in (shutter.readout_s, shutter.motion))
    return dataclasses.replace(found, shutter=RollingShutter(*tensors))


def at_time(still: View, after: float) -> View:
    """The view without rolling shutter from where the camera is so many seconds later."""
    moved = torch.eye(4)
    moved[:3, :3] = torch.from_numpy(Rotation.from_rotvec(after * VELOCITY[3:]).as_matrix())
    moved[:3, 3] = torch.from_numpy(after * VELOCITY[:3])
    return dataclasses.replace(still, camera_to_world=still.camera_to_world @ moved, time=TIME + after)


EVERY = 3
"""Lines from one that is compared to the next."""


def line_by_line(model: SplatModel, still: View, readout: tuple[float, float, float]) -> torch.Tensor:
    """Some lines of the image whose every line is that of a camera without rolling shutter at the time of the line."""
    down = readout[1] != 0.0
    lines, found = HEIGHT if down else WIDTH, []
    for line in range(0, lines, EVERY):
        after = ((line + 0.5) / lines - 0.5) * (readout[1] if down else readout[0]) + readout[2]
        image = model.render(at_time(still, after)).image
        found.append(image[line] if down else image[:, line])
    return torch.stack(found, dim=0 if down else 1)


@functools.cache
def model(rolling: bool = True) -> SplatModel:
    """A wall of small Gaussians, a vehicle that crosses before it, and a sky."""
    random = np.random.default_rng(0)
    wall = random.uniform([6.0, -8.0, -1.0], [9.0, 8.0, 3.0], (1500, 3))
    part = round_gaussians(wall, sizes=0.06, opacities=0.9)
    part.params["sh0"].data = torch.from_numpy(random.uniform(-1.5, 1.5, (1500, 1, 3))).float()
    motion = motion_through([0.0, 2.0], [[5.0, -7.0, 1.0], [5.0, 9.0, 1.0]])
    track = track_of(motion, size=(1.0, 1.0, 1.0))
    points = random.uniform(-0.5, 0.5, (400, 3))
    actors = Actors.from_points(
        [track], [points], [random.uniform(0.0, 1.0, (400, 3))], ActorSettings(),
        GaussianSettings(init_opacity=0.95, init_scale=1.5),
    )  # fmt: skip
    sky = CubemapSky(32, torch.tensor([0.3, 0.5, 0.8]), 1e-2)
    sky.params["texels"].data += torch.from_numpy(random.normal(0.0, 1.0, sky.params["texels"].shape)).float()
    return SplatModel([part, actors], sky, rolling_shutter=rolling).requires_grad_(False)


def error(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Of an image, in the lines of `line_by_line`."""
    shown = found.detach()[::EVERY] if expected.shape[1] == WIDTH else found.detach()[:, ::EVERY]
    return float((shown - expected.detach()).square().mean().sqrt())


@pytest.mark.parametrize("readout", [DOWN, RIGHT, (-0.06, 0.0, 0.0)])
def test_each_line_is_that_of_a_camera_at_its_own_time(readout):
    expected = line_by_line(model(), view(None), readout)
    ignored = error(model().render(view(None)).image, expected)
    assert ignored > 0.05 and error(model().render(view(readout)).image, expected) < 0.2 * ignored


def test_an_actor_moves_during_the_readout():
    expected = line_by_line(model(), view(None), RIGHT)
    alone = model().gaussians_in(view(RIGHT))
    assert (alone.velocities[:1500] == 0).all()
    torch.testing.assert_close(alone.velocities[1500:], torch.tensor([0.0, 8.0, 0.0]).expand(400, 3), atol=1e-2, rtol=0)
    still = dataclasses.replace(alone, velocities=None)
    resting = model().render(view(RIGHT), gaussians=still).image
    assert error(model().render(view(RIGHT)).image, expected) < 0.5 * error(resting, expected)


def test_a_model_without_rolling_shutter_renders_all_lines_at_once():
    found = model(rolling=False).render(view(DOWN))
    assert torch.equal(found.image, model().render(view(None)).image)
    assert found.shapes.velocities is None


def test_the_rays_of_a_line_are_those_at_its_time():
    rolling = view(DOWN).rays()
    for row in (0, 20, 47):
        after = ((row + 0.5) / HEIGHT - 0.5) * DOWN[1] + DOWN[2]
        torch.testing.assert_close(rolling[row], at_time(view(None), after).rays()[row], atol=2e-4, rtol=0.0)
    assert (rolling[0] - view(None).rays()[0]).abs().max() > 0.01
    turning, shutter = view(DOWN).turning_by_line, view(DOWN).shutter
    torch.testing.assert_close(shutter.angular_velocity, torch.from_numpy(VELOCITY[3:]).float())
    assert turning[1] * HEIGHT == pytest.approx(0.06) and turning[2] == pytest.approx(-0.028)


def test_other_renderings_of_the_same_gaussians_are_displaced_alike():
    picture = model().render(view(DOWN))
    alpha = model().objects_alpha(picture, view(DOWN))
    rows = model().rows[1]
    expected = model().render(view(DOWN), gaussians=picture.shapes[rows]).alpha
    torch.testing.assert_close(alpha, expected)
    assert (alpha - model().objects_alpha(picture, view(None))).abs().max() > 0.3


def test_the_depth_is_that_at_the_time_of_each_line():
    """Of a wall of Gaussians alone; the actor's own motion is not in the depth."""
    wall = SplatModel([model().parts[0]], None)
    alphas = [wall.render(view(readout)).alpha for readout in (DOWN, None)]
    dense = (alphas[0] > 0.9) & (alphas[1] > 0.9)
    assert dense.sum() > 300
    dense, rows = dense[::EVERY], range(0, HEIGHT, EVERY)

    def expected_depth(seen: View) -> torch.Tensor:
        return wall.render(seen, with_depth=True).depth

    def surface_depth(seen: View) -> torch.Tensor:
        return wall.render(seen, with_surface_depth=True).surface_depth

    for depth_of in (expected_depth, surface_depth):
        times = (((row + 0.5) / HEIGHT - 0.5) * DOWN[1] + DOWN[2] for row in rows)
        seen = (depth_of(at_time(view(None), after)) for after in times)
        expected = torch.stack([depth[row] for depth, row in zip(seen, rows, strict=True)])
        found, ignored = depth_of(view(DOWN)), depth_of(view(None))
        error, without = ((depth[::EVERY] - expected)[dense].abs().median() for depth in (found, ignored))
        assert error < 0.01 < without
        assert (found[alphas[0] == 0.0] == 0.0).all()


def test_overlapping_gaussians_keep_their_order():
    """Of two that overlap, the one below is read later, when it is nearer; at each pixel both are seen at one time."""
    places, sizes, colors = [[5.0, 0.0, 1.9], [5.05, 0.0, 1.1]], [0.6, 0.6], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    pair = SplatModel([round_gaussians(places, sizes=sizes, opacities=0.99, colors=colors)], None)
    expected = line_by_line(pair, view(None), DOWN)
    assert error(pair.render(view(DOWN)).image, expected) < 0.02


def test_gradients_pass_the_displacement_unchanged():
    part = round_gaussians(torch.rand(20, 3) * 5.0 + torch.tensor([4.0, -2.5, 0.0]))
    gaussians = sampled(part, 0.0)
    shown = where_seen(gaussians, view(DOWN))
    assert (shown.means - gaussians.means).abs().max() > 0.05
    shown.means.backward(weight := torch.randn(20, 3))
    torch.testing.assert_close(part.params["means"].grad, weight)
