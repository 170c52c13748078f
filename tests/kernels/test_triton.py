"""Triton's kernels agree with torch within rounding, and compile for GPUs.

Without a GPU they run in Triton's interpreter, see conftest.py.
"""

import dataclasses
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import REPOSITORY
from helpers.patience import PATIENCE_S
from helpers.trainings import ALL_TERMS, guided_views, settings_of, untrained_street
from scipy.spatial.transform import Rotation
from torch import nn

from drivesplat.kernels import triton_support
from drivesplat.kernels.alpha_entropy import mean_cross_entropy, mean_entropy
from drivesplat.kernels.color_difference import color_difference
from drivesplat.kernels.cube_map import CubeMap, over_cube_map
from drivesplat.kernels.depth_error import mean_depth_error
from drivesplat.kernels.gsplat_private import sh_basis
from drivesplat.kernels.mcmc import explore
from drivesplat.kernels.object_poses import corrected
from drivesplat.kernels.optimization import NEVER, AdamStep, adam_steps, record_not_finite
from drivesplat.kernels.placement import LocalGaussians, ObjectPoses, colors_in_world, place
from drivesplat.kernels.quaternions import rotation_matrix
from drivesplat.kernels.regularizers import mean_opacity_and_scale, mean_thickness, sums_of_squares
from drivesplat.kernels.road_distance import Road, by_torch, road_distance
from drivesplat.kernels.sparse_grid import SparseGrid
from drivesplat.kernels.view_colors import fused_view_colors, lidar_response
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.harmonics import rotation_of_harmonics, rotation_of_harmonics_by
from drivesplat.model.sky import CubemapSky
from drivesplat.model.view import RollingShutter, View
from drivesplat.model.view_colors import all_view_colors, rasterizer_colors
from drivesplat.settings.train import McmcSettings
from drivesplat.training.loop import Trainer

pytest.importorskip("triton", reason="Triton is not there for this system")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@contextmanager
def triton(used: bool) -> Iterator[None]:
    """Within this context the public functions run Triton's kernels, or those of torch and numba, on any device."""
    with patch.object(triton_support, "usable_for", lambda tensor: used):
        yield


def both_ways(function: Callable[..., Any], *arguments: Any) -> list[Any]:
    """The results without Triton and with it."""
    results = []
    for used in (False, True):
        with triton(used):
            results.append(function(*arguments))
    return results


def assert_same_gradients(results: list[Any], inputs: list[torch.Tensor], atol: float, rtol: float) -> None:
    """Of a random weighting of all values in both results."""
    weights = [torch.randn_like(value) for value in results[0]]
    expected, found = (
        torch.autograd.grad(values, inputs, weights, allow_unused=True, materialize_grads=True) for values in results
    )
    for theirs, ours in zip(expected, found, strict=True):
        torch.testing.assert_close(ours, theirs, atol=atol, rtol=rtol)


def a_pose() -> torch.Tensor:
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(Rotation.random(random_state=0).as_matrix())
    pose[:3, 3] = torch.tensor([0.5, -1.0, 2.0])
    return pose


def a_mask(height: int, width: int, seed: int, share: float = 0.2) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(size=(height, width)) < share).to(DEVICE)


@pytest.mark.parametrize(
    ("height", "width", "hidden", "moving"),
    [
        pytest.param(10, 45, True, True, id="wider than a block, and no multiple of it"),
        pytest.param(3, 4, False, False, id="smaller than a window, without masks"),
    ],
)
def test_color_differences_and_their_gradients_agree_with_torch(height, width, hidden, moving):
    rng = np.random.default_rng(0)
    image, recorded = (torch.from_numpy(rng.uniform(0, 1, (height, width, 3))).float().to(DEVICE) for _ in range(2))
    masks = [a_mask(height, width, seed) if wanted else None for seed, wanted in ((1, hidden), (2, moving))]
    image.requires_grad_()
    results = both_ways(color_difference, image, (255 * recorded).to(torch.uint8), *masks)
    values = [[value for value in vars(result).values() if value is not None] for result in results]
    assert [len(found) for found in values] == [2 + moving] * 2
    torch.testing.assert_close(values[1], values[0], atol=1e-5, rtol=1e-5)
    weights = (0.8, -0.2, 0.3)
    expected, found = (
        torch.autograd.grad(sum(w * v for w, v in zip(weights, vs, strict=False)), image)[0] for vs in values
    )
    assert float(expected.abs().max()) > 0.0
    torch.testing.assert_close(found, expected, atol=1e-8, rtol=1e-3)


def test_an_empty_moving_mask_gives_no_difference_and_no_gradient():
    image = torch.rand(4, 5, 3, device=DEVICE, requires_grad=True)
    nowhere = torch.zeros(4, 5, dtype=torch.bool, device=DEVICE)
    pixels = torch.zeros(4, 5, 3, dtype=torch.uint8, device=DEVICE)
    with triton(True):
        moving = color_difference(image, pixels, None, nowhere).moving_l1
    moving.backward()
    assert float(moving.detach()) == 0.0 and not image.grad.any()


def test_the_first_iterations_of_values_that_are_not_finite_agree_with_torch():
    count = 130
    values = torch.linspace(-3.0, 3e38, count, device=DEVICE)
    values[::3], values[1::5], values[2::7] = torch.nan, torch.inf, -torch.inf
    found = []
    for used in (False, True):
        first = torch.full((count,), NEVER, device=DEVICE)
        first[::2] = 5
        with triton(used):
            for step in (7, 3):
                record_not_finite(values, torch.tensor(step, device=DEVICE), first)
        found.append(first)
    assert torch.equal(*found) and (found[0] == 3).any()


def adam_state(parameter: torch.Tensor) -> dict[str, torch.Tensor]:
    return {**{name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}, "step": scalar(0.0)}


def scalar(value: float) -> torch.Tensor:
    return torch.tensor(value, device=DEVICE)


def test_adam_steps_agree_with_torch():
    """More parameters than one launch has, of no, one and several blocks, each at its own rate."""
    torch.manual_seed(0)
    sizes = (0, 1, 7, 1024, 1025, 3000, 2, 900, 2048, 5)
    mine = [torch.nn.Parameter(torch.randn(size, 1, 3, device=DEVICE)) for size in sizes]
    theirs = [parameter.detach().clone() for parameter in mine]
    steps = [AdamStep(p, adam_state(p), scalar(0.02 / (k + 1)), scalar(0.0)) for k, p in enumerate(mine)]
    groups = [{"params": [p], "lr": 0.02 / (k + 1)} for k, p in enumerate(theirs)]
    adam = torch.optim.Adam(groups, eps=1e-15, fused=True)
    with triton(True):
        for number in range(8):
            for own, their, step, group in zip(mine, theirs, steps, adam.param_groups, strict=True):
                own.grad = their.grad = torch.randn_like(their) * 10.0 ** -(number % 7)
                step.rate.mul_(0.9)
                group["lr"] *= 0.9
            adam_steps(steps, (0.9, 0.999), 1e-15)
            adam.step()
            torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-5, check_device=False)
    assert not any(step.broken for step in steps)


@pytest.mark.parametrize("value", [torch.nan, -torch.inf, 1e25])
@pytest.mark.parametrize("used", [True, False])
def test_an_adam_step_reports_the_gradient_that_is_not_finite(used, value):
    """Or its square. Triton's kernel does so for good: a later gradient may be finite again."""
    parameters = [torch.nn.Parameter(torch.ones(700, 3, device=DEVICE)) for _ in range(2)]
    steps = [AdamStep(p, {**adam_state(p), "step": scalar(1.0)}, scalar(0.02), scalar(0.0)) for p in parameters]
    found = []
    for wrong in (0.5, value, 0.5):
        for parameter in parameters:
            parameter.grad = torch.full_like(parameter, 0.5)
        parameters[1].grad[650, 1] = wrong
        with triton(used):
            found.append([bool(own.isfinite()) for own in adam_steps(steps, (0.9, 0.999), 1e-15)])
    assert found == [[True, True], [True, False], [True, not used]]


@pytest.mark.parametrize(("objects", "annotations"), [(3, 20), (5, 300)])
def test_corrected_poses_and_their_gradients_agree_with_torch(objects, annotations):
    torch.manual_seed(0)
    quats = F.normalize(torch.randn(objects, 4, device=DEVICE), dim=1)
    translations, weights = torch.randn(objects, 3, device=DEVICE), torch.randn(annotations, device=DEVICE)
    owner = torch.arange(annotations, device=DEVICE) * objects // annotations
    yaw, shifts = (torch.randn(annotations, *size, device=DEVICE, requires_grad=True) for size in ((), (3,)))
    expected, found = both_ways(lambda: corrected(quats, translations, weights, owner, yaw, shifts))
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-5)
    assert_same_gradients([expected, found], [yaw, shifts], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("coefficients", [1, 4])
def test_rotations_of_harmonics_by_quaternions_agree_with_torch(coefficients):
    torch.manual_seed(0)
    quats = F.normalize(torch.randn(40, 4, device=DEVICE), dim=1)
    expected, found = both_ways(lambda: rotation_of_harmonics_by(quats, coefficients))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(found, rotation_of_harmonics(rotation_matrix(quats), coefficients), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("annotations", [0, 3, 400])
def test_penalties_of_tracks_and_their_gradients_agree_with_torch(annotations):
    """Of two tracks with a gap between them."""
    torch.manual_seed(0)
    yaw, shifts = (torch.randn(annotations, *size, device=DEVICE, requires_grad=True) for size in ((), (3,)))
    starts = torch.arange(max(0, annotations - 2))
    neighbours = (starts[(starts < 300) | (starts > 302)][:, None] + torch.arange(3)).to(DEVICE)
    results = both_ways(lambda: sums_of_squares(shifts, yaw, neighbours, 0.1, 0.03))
    torch.testing.assert_close(results[1], results[0], atol=1e-4, rtol=1e-5)
    assert_same_gradients(results, [yaw, shifts], atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize(
    ("degree", "coefficients", "wider"), [(0, 1, False), (1, 4, True), (0, 9, True), (1, 9, False)]
)
def test_fused_view_colors_agree_with_gsplats_basis(degree, coefficients, wider):
    """Also where the colours are columns of a `wider` tensor."""
    torch.manual_seed(0)
    pose = a_pose()
    sizes = ((300, 3), (300, 1, 3), (300, coefficients - 1, 3))
    inputs = [torch.randn(size, device=DEVICE).requires_grad_() for size in sizes]
    basis = sh_basis(coefficients, F.normalize(inputs[0] - pose[:3, 3].to(DEVICE), dim=1))
    used = (degree + 1) ** 2
    expected = (basis[:, :used, None] * torch.cat(inputs[1:], dim=1)[:, :used]).sum(dim=1) + 0.5
    expected = expected.clamp(min=0.0)
    with triton(True):
        found = fused_view_colors(*inputs, pose.to(DEVICE), degree)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    beside = torch.ones(300, 1, device=DEVICE)
    results = [[torch.cat([colors, beside], dim=1) if wider else colors] for colors in (expected, found)]
    assert_same_gradients(results, inputs, atol=1e-4, rtol=1e-4)


def test_no_fused_view_colors_without_triton_or_for_a_learned_camera_or_a_high_degree():
    values = [torch.zeros(2, *size, device=DEVICE) for size in ((3,), (1, 3), (8, 3))]
    pose = torch.eye(4, device=DEVICE)
    with triton(True):
        assert fused_view_colors(*values, pose, 2) is None
        assert fused_view_colors(*values, pose.clone().requires_grad_(), 1) is None
    with triton(False):
        assert fused_view_colors(*values, pose, 1) is None


@pytest.mark.parametrize("degree", [0, 2])
def test_colors_of_all_gaussians_have_all_coefficients(degree):
    """Also of those behind the camera and beside its view."""
    torch.manual_seed(0)
    pose = a_pose()
    means, sh = torch.randn(300, 3, device=DEVICE), torch.randn(300, (degree + 1) ** 2, 3, device=DEVICE)
    basis = sh_basis((degree + 1) ** 2, F.normalize(means - pose[:3, 3].to(DEVICE), dim=1))
    expected = ((basis[..., None] * sh).sum(dim=1) + 0.5).clamp(min=0.0)
    shapes = [torch.ones(300, *size, device=DEVICE) for size in ((4,), (3,), ())]
    view = View(torch.eye(3, device=DEVICE), pose.to(DEVICE), 8, 6, time=0.0)
    found = all_view_colors(Gaussians.of(means, *shapes, sh), view)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def test_colors_of_several_sets_equal_those_of_one():
    """Also where one has no coefficients of degree 1."""
    torch.manual_seed(0)
    sets = [
        Gaussians.of(*(torch.randn(count, *size, device=DEVICE) for size in ((3,), (4,), (3,), (), (k, 3))))
        for count, k in ((30, 4), (20, 1), (0, 4))
    ]
    view = View(torch.eye(3, device=DEVICE), torch.eye(4, device=DEVICE), 8, 6, time=0.0)
    with triton(True):
        found = [rasterizer_colors(of, view) for of in (sets, [concatenate(sets)])]
    torch.testing.assert_close(found[0], found[1])


@pytest.mark.parametrize("counts", [(1, 1), (1100, 0, 300)])
def test_regularized_means_over_sets_and_their_gradients_agree_with_torch(counts):
    torch.manual_seed(0)
    sets = []
    for count in counts:
        opacities, scales = torch.rand(count, device=DEVICE), 5.0 * torch.rand(count, 3, device=DEVICE)
        opacities[2::3] = 0.0
        sets.append((opacities.requires_grad_(), scales.requires_grad_()))
    expected, found = both_ways(mean_opacity_and_scale, *sets)
    together = [torch.cat(values) for values in zip(*sets, strict=True)]
    present = together[0][:, None] > 0.0
    torch.testing.assert_close(expected[0], together[0].mean())
    torch.testing.assert_close(expected[1], (together[1] * present).mean())
    torch.testing.assert_close(found, expected)
    assert_same_gradients([expected, found], [values for own in sets for values in own], atol=1e-9, rtol=1e-5)


def test_the_mean_thickness_and_its_gradient_agree_with_torch():
    count = 1100
    torch.manual_seed(count)
    scales = torch.rand(count, 3, device=DEVICE).requires_grad_()
    expected, found = both_ways(lambda: [mean_thickness(scales)])
    torch.testing.assert_close(found, expected)
    assert_same_gradients([expected, found], [scales], atol=1e-9, rtol=1e-5)
    broken = scales.detach().clone()
    broken[0, 1] = torch.nan
    with triton(True):
        assert mean_thickness(broken).isnan()


@pytest.mark.parametrize(("masked", "width"), [(False, 77), (True, 1), (True, 77)])
def test_the_entropy_of_alpha_and_its_gradient_agree_with_torch(masked, width):
    torch.manual_seed(width)
    alpha = (1.2 * torch.rand(23, width, device=DEVICE) - 0.1).clamp(0.0, 1.0).requires_grad_()
    empty = torch.rand(23, width, device=DEVICE) < 0.3

    def mean() -> list[torch.Tensor]:
        return [mean_cross_entropy(alpha, empty) if masked else mean_entropy(alpha)]

    expected, found = both_ways(mean)
    torch.testing.assert_close(found, expected)
    assert_same_gradients([expected, found], [alpha], atol=1e-7, rtol=1e-4)
    broken = alpha.detach().clone()
    broken[2, 0] = torch.nan
    with triton(True):
        assert mean_entropy(broken).isnan() and mean_cross_entropy(broken, empty).isnan()


@pytest.mark.parametrize(("count", "room"), [(19, 19), (0, 40), (2500, 2500), (1700, 2100)])
def test_errors_of_depth_and_their_gradient_agree_with_torch(count, room):
    torch.manual_seed(room)
    depth = (1.0 + 8.0 * torch.rand(60, 50, device=DEVICE)).requires_grad_()
    pixels = torch.randperm(3000, device=DEVICE)[:room]
    measured = depth.detach().flatten()[pixels] + torch.randn(room, device=DEVICE).exp()
    measured[count:] = torch.nan
    used = None if count == room else torch.tensor(count, device=DEVICE)
    expected, found = both_ways(lambda: [mean_depth_error(depth, pixels, measured, used)])
    torch.testing.assert_close(found, expected, atol=0.0, rtol=1e-5)
    theirs, mine = (torch.autograd.grad(mean, depth)[0] for (mean,) in (expected, found))
    apart = ((mine - theirs).abs() > 1e-7).sum()
    assert apart <= 4, "errors that agree in 22 bits with the last one that counts share its weight"
    torch.testing.assert_close(mine.sum(), theirs.sum(), atol=1e-6, rtol=1e-5)


def test_of_equal_errors_of_depth_those_that_count_share_their_weight():
    """40 errors of 2 m, of which 38 count."""
    depth = torch.full((8, 5), 3.0, device=DEVICE, requires_grad=True)
    with triton(True):
        found = mean_depth_error(depth, torch.arange(40, device=DEVICE), torch.full((40,), 5.0, device=DEVICE))
    (gradient,) = torch.autograd.grad(found, depth)
    assert float(found.detach()) == 2.0
    torch.testing.assert_close(gradient, torch.full_like(depth, -1.0 / 40.0))


@pytest.mark.parametrize("count", [0, 300])
def test_the_response_to_a_lidar_and_its_gradients_agree_with_torch(count):
    torch.manual_seed(count)
    means, sensor = 20.0 * torch.randn(count, 3, device=DEVICE), torch.tensor([1.0, -2.0, 1.8], device=DEVICE)
    means[:1] = sensor
    logits = (2.0 * torch.randn(count, 4, 2, device=DEVICE)).requires_grad_()
    expected, found = both_ways(lambda: [lidar_response(logits, means.requires_grad_(), sensor)])
    torch.testing.assert_close(found, expected)
    assert_same_gradients([expected, found], [logits, means], atol=1e-6, rtol=1e-4)
    assert expected[0].shape == (count, 2)


@pytest.mark.parametrize("listed", [1, 37])
def test_distances_from_a_road_and_their_gradients_agree_with_torch(listed, monkeypatch):
    """Triton, and without it numba on the CPU. A road of one cell, with gaps, and of all cells; Gaussians out of reach,
    outside and of opacity 0 among them; more blocks than the sum of all reads at a time."""
    monkeypatch.setattr("drivesplat.kernels.triton.road_distance.SUMS", 4)
    torch.manual_seed(listed)
    keys = torch.randperm(64)[:listed].sort().values
    normals = F.normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.1 * torch.randn(listed, 3), dim=1)
    cells = SparseGrid(torch.tensor([-4.0, -4.0]), 1.0, (8, 8), keys)
    road = Road(cells, normals, 0.1 * torch.randn(listed), torch.rand(listed), 0.4).to(DEVICE)
    means = torch.rand(800, 3, device=DEVICE) * torch.tensor([10.0, 10.0, 1.0], device=DEVICE) - 0.5
    means[:, :2] -= 4.5
    scales, quats = 0.3 * torch.rand(800, 3, device=DEVICE), 2.0 * torch.randn(800, 4, device=DEVICE)
    opacities = torch.rand(800, device=DEVICE)
    opacities[::3] = 0.0
    inputs = [values.requires_grad_() for values in (means, quats, scales)]
    expected = [by_torch(*inputs, opacities, road)]
    assert float(expected[0].detach()) > 0.0
    for found in both_ways(lambda *given: [road_distance(*given, opacities, road)], *inputs):
        torch.testing.assert_close(found, expected)
        assert_same_gradients([[by_torch(*inputs, opacities, road)], found], inputs, atol=1e-7, rtol=1e-4)


@pytest.mark.parametrize("seed", [0, 3])
def test_an_image_over_a_cube_map_and_its_gradients_agree_with_torch(seed):
    """For cameras that see edges and corners of the cube, and few texels by a long focal length with a rolling
    shutter."""
    torch.manual_seed(seed)
    sky = CubemapSky(9, torch.tensor([0.3, 0.5, 0.7]), 1e-2).to(DEVICE)
    texels = sky.params["texels"]
    texels.data += torch.randn_like(texels)
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    K = torch.tensor([[10.0, 0.0, 14.0], [0.0, 11.0, 6.0], [0.0, 0.0, 1.0]])
    K[:2, :2] *= (seed % 2) * 9.0 + 1.0
    turning = 4.0 * torch.cross(torch.eye(3), torch.randn(3, 1).expand(3, 3), dim=0)
    motion = torch.cat([turning, torch.ones(3, 1)], dim=1).to(DEVICE)
    shutter = RollingShutter(torch.tensor([0.03, -0.05, 0.01], device=DEVICE), motion)
    view = View(K.to(DEVICE), pose.to(DEVICE), 29, 13, 0.0, shutter=shutter if seed > 1 else None)
    image, alpha = torch.rand(13, 29, 3, device=DEVICE), 0.99 * torch.rand(13, 29, 1, device=DEVICE)
    alpha[3:5] = 1.0
    inputs = [image.requires_grad_(), alpha.requires_grad_(), texels]
    cube = CubeMap(texels, sky.index)
    camera = view.K, view.camera_to_world, view.rays, view.turning_by_line
    expected, found = both_ways(over_cube_map, image, alpha, cube, *camera)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0.0)
    assert_same_gradients([[expected], [found]], inputs, atol=1e-5, rtol=1e-4)


@pytest.mark.slow
def test_exploration_has_the_covariance_of_equation_8_and_leaves_opaque_gaussians_in_place():
    """Over many draws: strength² times the squared covariance of the Gaussian, for a faint one."""
    torch.manual_seed(0)
    count, strength, logit = 20_000, 2.0, -6.0
    rows = {"means": [5.0, -3.0, 1.0], "quats": [1.0, 0.3, -0.2, 0.5], "scales": [0.0, -1.0, -0.5]}
    params = nn.ParameterDict({name: nn.Parameter(torch.tensor(row).repeat(count, 1)) for name, row in rows.items()})
    params["opacities"] = nn.Parameter(torch.full((count,), logit))
    params["opacities"].data[count // 2 :] = 3.0
    params = params.to(DEVICE)
    with triton(True):
        explore(params, strength)
    moved = params["means"].detach().cpu().double() - torch.tensor(rows["means"])
    faint, opaque = moved[: count // 2], moved[count // 2 :]
    assert float(opaque.abs().max()) < 1e-5
    turn = Rotation.from_quat(rows["quats"], scalar_first=True).as_matrix()
    covariance = torch.from_numpy(turn @ np.diag(np.exp(rows["scales"]) ** 2) @ turn.T)
    factor = 1.0 / (1.0 + np.exp(100.0 * (1.0 / (1.0 + np.exp(-logit)) - 0.005)))
    expected = (strength * factor) ** 2 * covariance @ covariance.T
    torch.testing.assert_close(torch.cov(faint.T), expected, rtol=0.06, atol=0.01)
    assert float(faint.mean(dim=0).abs().max()) < 5.0 * float(expected.diagonal().max().sqrt()) / np.sqrt(count // 2)


def test_exploration_follows_from_the_seed():
    ends = []
    for seed in (1, 1, 2):
        params = nn.ParameterDict(
            {"means": torch.zeros(50, 3), "quats": torch.ones(50, 4), "scales": torch.zeros(50, 3)}
        ).to(DEVICE)
        params["opacities"] = torch.full((50,), -6.0, device=DEVICE)
        torch.manual_seed(seed)
        with triton(True):
            explore(params, 1.0)
            explore(params, 1.0)
        ends.append(params["means"].detach().clone())
    assert torch.equal(ends[0], ends[1]) and not torch.equal(ends[0], ends[2])


def some_objects(requires_grad: bool = True) -> tuple[ObjectPoses, torch.Tensor, torch.Tensor]:
    """Five objects, one of them absent, two of other sizes; the owners of 150 Gaussians, and their one-hot matrix."""
    quats = F.normalize(torch.randn(5, 4, device=DEVICE), dim=1).requires_grad_(requires_grad)
    translations = torch.randn(5, 3, device=DEVICE).requires_grad_(requires_grad)
    sizes, presence = torch.tensor([[1.0, 1.0, 2.0, 0.5, 1.0], [1.0, 0.0, 1.0, 1.0, 1.0]], device=DEVICE)
    owner = torch.randint(5, (150,), device=DEVICE)
    return ObjectPoses(quats, translations, sizes, presence), owner, F.one_hot(owner, 5).float()


def test_placed_gaussians_and_their_gradients_agree_with_torch():
    torch.manual_seed(0)
    sizes = ((3,), (4,), (3,), ())
    local = LocalGaussians(*(torch.randn(150, *size, device=DEVICE).requires_grad_() for size in sizes))
    objects, owner, owns = some_objects()
    results = both_ways(place, local, objects, owner, owns)
    torch.testing.assert_close(results[1], results[0], atol=1e-5, rtol=1e-5)
    assert_same_gradients(results, [*local, objects.quats, objects.translations], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(("degree", "terms"), [(0, 5), (1, 5), pytest.param(3, 2, marks=pytest.mark.slow)])
def test_time_varying_colors_and_their_gradients_agree_with_torch(degree, terms):
    torch.manual_seed(1)
    objects, owner, owns = some_objects(requires_grad=False)
    k, series = (degree + 1) ** 2, torch.randn(5, terms, device=DEVICE)
    series[:, 0] = 1.0  # the constant term's cosine
    rotations = rotation_of_harmonics(rotation_matrix(objects.quats), k)
    sh0, shN = (torch.randn(150, terms, size, 3, device=DEVICE).requires_grad_() for size in (1, k - 1))
    expected, found = both_ways(colors_in_world, sh0, shN, series, rotations, owner, owns)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    assert_same_gradients([expected, found], [sh0, shN], atol=1e-5, rtol=1e-5)


def stretch(model):
    """Makes Gaussians of what start as spheres, whose rotations would learn from rounding alone."""
    generator = torch.Generator().manual_seed(0)
    for part in model.parts:
        scales = part.params["scales"].data
        scales += 0.5 * torch.randn(scales.shape, generator=generator)


@pytest.mark.slow
@pytest.mark.parametrize("body", [False, True])
def test_a_training_with_triton_agrees_with_one_without(body, monkeypatch):
    """Two iterations of background, cars and a cube map, with every term of the loss, and the ego vehicle's body."""
    ends = []
    for kernels in (True, False):
        monkeypatch.setattr(triton_support, "usable_for", lambda tensor, kernels=kernels: kernels)
        settings = settings_of(**ALL_TERMS, mcmc=McmcSettings(noise_lr=0.0), refine_start=1.0)
        model = untrained_street(settings)
        model.sky = CubemapSky(6, torch.full((3,), 0.5), 1e-2)
        stretch(model)
        views = guided_views(DEVICE)
        if body:
            ego_mask = torch.zeros_like(views[0].sky)
            ego_mask[-4:, 5:20] = True
            views = [dataclasses.replace(view, ego_mask=ego_mask) for view in views]
        before = {name: value.clone() for name, value in model.state_dict().items()}
        trainer = Trainer.begin(model.to(DEVICE), views, settings, 0, DEVICE)
        for _ in range(2):
            terms, picture, _ = trainer.training_step()
            trainer.densify(picture)
        ends.append((terms, model.state_dict()))
    (terms, mine), (their_terms, theirs) = ends
    assert terms.keys() == their_terms.keys() and {"l1", "ssim", "dynamic", "sky_bce", "track_size"} <= terms.keys()
    for name, value in their_terms.items():
        torch.testing.assert_close(terms[name], value, atol=1e-5, rtol=1e-3)
    for name, value in theirs.items():  # Adam makes whole steps of rounding where a gradient is 0
        moved = (value.cpu() - before[name]).abs().float()
        if moved.any():
            apart = (mine[name] - value).abs().cpu()
            assert float(apart.quantile(0.7)) <= 0.01 * float(moved.max()), name
    assert (theirs["parts.1.params.means"].cpu() != before["parts.1.params.means"]).any()


COMPILED = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from drivesplat.kernels.triton import alpha_entropy, chunks, color_difference, cube_map, exploration
from drivesplat.kernels.triton import placement, probe, regularizers, tiles, time_varying_colors, view_colors
from drivesplat.kernels.triton import colored_projection, road_distance
from drivesplat.kernels.triton import depth_error, joined_chunks, lidar_response, object_poses, optimization
from drivesplat.kernels.triton import scan_chunks, scan_compositing, scan_gradients, scan_projection, scan_sums
from drivesplat.kernels.triton import scan_tiles, track_penalties

FLOATS, IN = "*fp32", {"pixels": "*u8", "hidden": "*i1", "moving": "*i1", "empty": "*i1", "index": "*i64",
              "owner": "*i64",
              "ids": "*i32", "order": "*i64", "offsets": "*i32", "firsts": "*i32", "starts": "*i32", "exists": "*i1",
              "places": "*i32", "neighbours": "*i64",
              "radii": "*i32", "counts": "*i32", "nearest": "*i64", "ends": "*i32", "keys": "*i16"}
NUMBERS = dict.fromkeys(("height", "values", "width", "resolution", "count", "seed"), "i32")
NUMBERS |= dict.fromkeys(("tiles", "per_camera", "across", "steps", "capacity", "each", "stride"), "i32")
NUMBERS |= dict.fromkeys(("c1", "c2", "strength", "eps", "certain"), "fp32")
NUMBERS |= dict.fromkeys(("rows", "columns", "beams", "firings", "triples"), "i32")
NUMBERS |= dict.fromkeys(("first_count", "last_count", "room", "blocks"), "i32")
NUMBERS |= dict.fromkeys(("spread_a", "spread_e", "max_range", "per_metre", "per_radian"), "fp32")
IN |= {"first": "*i32", "last": "*i32", "sorted_ids": "*i32"}
NUMBERS |= {f"{name}{i}": "fp32" for name in ("beta", "rest", "log_beta") for i in (1, 2)}

RAYS = {"numbers": "*i32", "values": FLOATS}
DEPTHS = {"pixels": "*i64", "count": "*i64", "bins": "*i32", "finer": "*i32", "last": FLOATS}
SCAN = dict.fromkeys((scan_projection._project, scan_projection._project_backward), {"offsets": FLOATS})
SCAN |= dict.fromkeys((scan_tiles._count_tiles, scan_tiles._list), {"radii": FLOATS, "nearest": "*i32"})
SCAN[scan_chunks._copy] = RAYS
COLORED = {"values": FLOATS, "first": "i32"}
SUMS = {"first": "i32", "total": "i32"}
SCAN |= dict.fromkeys((colored_projection._project, colored_projection._project_backward), COLORED)
SCAN |= dict.fromkeys((regularizers._sums, regularizers._spread), SUMS)
ROAD = {"offsets": FLOATS, "keys": "*i64", "known": "i32", "edge": "fp32", "reach": "fp32", "roughness": "fp32",
        "cells": "*i32"}
SCAN |= dict.fromkeys((road_distance._distances, road_distance._distances_backward), ROAD)
SCAN[optimization._record] = {"values": FLOATS, "step": "*i64", "first": "*i64"}
SCAN[optimization._step] = {
    **dict.fromkeys(("values", "gradients", "averages", "squares", "counted", "rates", "broken"), 8 * (FLOATS,)),
    **{f"count{k}": "i32" for k in range(8)},
}
SCAN[optimization._count] = {"counted": 8 * (FLOATS,)}
SCAN |= dict.fromkeys((depth_error._errors, depth_error._refine, depth_error._sum, depth_error._gradients), DEPTHS)
SCAN |= dict.fromkeys((scan_sums._pass, scan_sums._composite, scan_compositing._join), RAYS)
SCAN |= dict.fromkeys((scan_gradients.remain, scan_gradients.add_gradients), RAYS)

def compiled(kernel, **constants):
    # constants that are not given are those of its module
    own = {p.name: kernel.fn.__globals__.get(p.name) for p in kernel.params if p.is_constexpr}
    constants = own | constants
    kinds = {name: "constexpr" if name in constants else {**IN, **NUMBERS}.get(name, FLOATS)
             for name in kernel.arg_names}
    if kernel in (cube_map._blend, cube_map._gradients):
        kinds["pixels"] = "i32"
    if kernel in (chunks._split, joined_chunks._composite, joined_chunks._composite_backward):
        kinds["values"] = FLOATS
    kinds |= {name: kind for name, kind in SCAN.get(kernel, {}).items() if name in kinds}
    places = {(kernel.arg_names.index(name),): value for name, value in constants.items()}
    source = ASTSource(fn=kernel, signature=kinds, constexprs=places)
    assert triton.compile(source, target=GPUTarget("cuda", 80, 32)).asm["cubin"], kernel

for module, names in (
    (probe, "_increment"), (road_distance, "_distances_backward"), (tiles, "_count_tiles _list"),
    (lidar_response, "_values _values_backward"), (placement, "_place _place_backward"),
    (optimization, "_count _record _step"),
    (regularizers, "_sums _means _spread _thinnest _spread_to_thinnest"), (depth_error, "_errors _gradients"),
    (scan_tiles, "_count_tiles _compact _list"), (scan_sums, "_pass"), (scan_compositing, "_arrive"),
    (exploration, "_move"), (cube_map, "_blend _gradients"), (object_poses, "_correct _correct_backward"),
    (track_penalties, "_sums _gradients"), (chunks, "count_chunks"),
):
    for name in names.split():
        compiled(getattr(module, name))
for k, degree in ((1, 0), (9, 1)):
    for kernel in (view_colors._colors, view_colors._colors_backward):
        compiled(kernel, OTHERS=k - 1, DEGREE=degree)
for k, degree, depth in ((1, 0, True), (9, 1, False)):
    for kernel in (colored_projection._project, colored_projection._project_backward):
        compiled(kernel, OTHERS=k - 1, DEGREE=degree, DEPTH=depth)
compiled(road_distance._distances, STEPS=17)
compiled(road_distance._mean, BLOCK=road_distance.SUMS)
for kernel in (alpha_entropy._sums, alpha_entropy._gradients):
    compiled(kernel, MASKED=True)
for kernel in (depth_error._refine, depth_error._sum):
    compiled(kernel, kept_percent=95)
for kernel in (chunks._split, chunks._sum_copies):
    compiled(kernel, CHANNELS=3)
for kernel in (joined_chunks._composite, joined_chunks._composite_backward):
    compiled(kernel, CHANNELS=4, WIDTH=4, DEPTH=True, OBJECTS=True)
for motion, moving, parts in ((True, True, 2), (False, False, 1)):
    options = {"WITH_MOTION": motion, "MOVING": moving, "PARTS": parts}
    compiled(scan_projection._project, STEPS=4, **options)
    compiled(scan_projection._project_backward, **options)
compiled(scan_chunks._copy, CHANNELS=2)
compiled(scan_sums._composite, CHANNELS=2, WIDTH=2)
for kernel in (scan_compositing._join, scan_gradients.remain):
    compiled(kernel, CHANNELS=2, JOINED=scan_compositing.JOINED)
compiled(scan_gradients.add_gradients, CHANNELS=2, GROUP=scan_sums.GROUP_BACKWARD)
compiled(object_poses._rotate_harmonics, K=4)
for kernel in (time_varying_colors._colors, time_varying_colors._colors_backward):
    for k in (1, 16):
        compiled(kernel, TERMS=5, K=k, PADDED=k, BLOCK=time_varying_colors.PRODUCTS // (4 * k**2))
compiled(color_difference._window_along_rows, TAPS=11)
compiled(color_difference._means_along_rows, HIDDEN=True, TAPS=11)
for kernel in (color_difference._similarity, color_difference._gradient):
    compiled(kernel, HIDDEN=True, MOVING=True, TAPS=11)
    compiled(kernel, HIDDEN=False, MOVING=False, hidden=None, moving=None, TAPS=11)
"""


def test_every_kernel_compiles():
    """Needs no GPU: it is what the interpreter does not try."""
    environment = {**os.environ, "TRITON_INTERPRET": "0"}
    done = subprocess.run([sys.executable, "-c", COMPILED], cwd=REPOSITORY, env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.parametrize("switch", ["0", "1"])
def test_without_triton_torch_is_used(switch, monkeypatch, caplog):
    """No warning where the user has disabled Triton; one where it fails."""
    from drivesplat.kernels.triton import probe

    def fail() -> None:
        raise RuntimeError("Failed to find C compiler.\nmore")

    monkeypatch.setenv(triton_support.SWITCH, switch)
    monkeypatch.setattr(probe, "run", fail)
    with unchecked():
        assert not triton_support.compiles() and not triton_support.compiles()
        assert [record.message.count("Failed to find C compiler.") for record in caplog.records] == [1] * int(switch)


@pytest.mark.parametrize(("device", "switch", "checks"), [("cuda", "1", 1), ("cuda", "0", 0), ("cpu", "1", 0)])
def test_triton_is_checked_once_in_a_thread_where_there_is_a_gpu(device, switch, checks, monkeypatch):
    from drivesplat.kernels.triton import probe

    begun, released, ran = threading.Event(), threading.Event(), []

    def wait() -> None:
        ran.append(threading.current_thread())
        begun.set()
        released.wait(PATIENCE_S)

    monkeypatch.setenv(triton_support.SWITCH, switch)
    monkeypatch.setattr(probe, "run", wait)
    with unchecked():
        triton_support.start_check(torch.device(device))
        assert begun.wait(PATIENCE_S if checks else 0.1) == bool(checks)
        released.set()
        assert triton_support.compiles() == (switch == "1")
        triton_support.start_check(torch.device(device))
        assert len(ran) == int(switch) and threading.current_thread() not in ran


@contextmanager
def unchecked() -> Iterator[None]:
    """Forgets before and after it whether Triton compiles."""
    cached = triton_support.compiles, triton_support._check
    for function in cached:
        function.cache_clear()
    try:
        yield
    finally:
        for function in cached:
            function.cache_clear()


def test_triton_is_not_used_for_tensors_on_a_cpu():
    assert not triton_support.usable_for(torch.zeros(1))
