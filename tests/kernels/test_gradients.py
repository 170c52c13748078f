"""The gradients of the differentiable operations of `drivesplat.kernels` that need no list of tiles, on the CPU.

They equal finite differences for one and several rows, agree in both precisions, and do not drop NaN.
Compositing and projection onto tiles are compared with references in tests/rasterization."""

from collections.abc import Callable, Iterator
from functools import partial

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from drivesplat.kernels.alpha_entropy import mean_cross_entropy, mean_entropy
from drivesplat.kernels.color_difference import color_difference, masked_l1, ssim
from drivesplat.kernels.cube_map import CubeMap, cube_map_colors, over_cube_map
from drivesplat.kernels.depth_error import mean_depth_error
from drivesplat.kernels.object_poses import corrected
from drivesplat.kernels.placement import (
    LocalGaussians,
    ObjectPoses,
    colors_in_object,
    colors_in_world,
    mirrored,
    of_owners,
    place,
)
from drivesplat.kernels.quaternions import about_vertical, left_factor, rotated_back, rotation_matrix, turned
from drivesplat.kernels.regularizers import mean_opacity_and_scale, mean_thickness, sums_of_squares
from drivesplat.kernels.road_distance import Road, road_distance
from drivesplat.kernels.sparse_grid import SparseGrid
from drivesplat.kernels.view_colors import lidar_response, view_colors
from drivesplat.model.sky import shared_vertices

Operation = tuple[Callable[..., object], dict[str, Tensor]]
"""A function of tensors with gradients, and these by name."""


class Given:
    """Random tensors of one precision. All values are chosen in double precision first, so that both are alike."""

    def __init__(self, dtype: torch.dtype, count: int):
        self.dtype, self.count, self.random = dtype, count, torch.Generator().manual_seed(0)

    def uniform(self, *shape: int, low: float = -1.0, high: float = 1.0) -> Tensor:
        values = torch.rand(shape, generator=self.random, dtype=torch.float64)
        return (low + (high - low) * values).to(self.dtype)

    def unit(self, *shape: int) -> Tensor:
        return normalize(self.uniform(*shape, low=0.2), dim=-1)

    def numbers(self, below: int, count: int) -> Tensor:
        return torch.randint(max(1, below), (count,), generator=self.random)


def owners(given: Given, objects: int = 3) -> tuple[Tensor, Tensor]:
    owner = given.numbers(objects, given.count)
    return owner, one_hot(owner, objects).to(given.dtype)


def image(given: Given, *channels: int) -> Tensor:
    """An image of as many rows as there are counted; without any it has no pixel."""
    return given.uniform(given.count, 4, *channels, low=0.05, high=0.95)


def of_images(given: Given) -> Iterator[tuple[str, Operation]]:
    pixels = (255 * image(given, 3)).to(torch.uint8)
    hidden, moving = image(given) > 0.8, image(given) > 0.5
    target, empty, shown, alpha = image(given, 3), image(given) > 0.5, image(given, 3), image(given)
    yield "mean_entropy", (mean_entropy, {"alpha": alpha})
    yield "mean_cross_entropy", (lambda alpha: mean_cross_entropy(alpha, empty), {"alpha": alpha})
    yield "masked_l1", (lambda image: masked_l1(image, target, moving), {"image": shown})
    yield "ssim", (lambda image: ssim(image, target), {"image": shown})

    def difference(image: Tensor) -> list[Tensor]:
        found = color_difference(image, pixels, hidden, moving)
        return [found.l1, found.ssim, found.moving_l1]

    yield "color_difference", (difference, {"image": shown})
    measured = given.numbers(shown.shape[0] * 4, 3 * given.count)
    depths, seen = 10.0 * image(given), 10.0 * given.uniform(len(measured), low=0.1)
    yield "mean_depth_error", (lambda depth: mean_depth_error(depth, measured, seen), {"depth": depths})
    index, count = shared_vertices(4)
    texels, rays = given.uniform(count, 3), given.unit(given.count, 4, 3)
    yield "cube_map_colors", (lambda texels: cube_map_colors(CubeMap(texels, index), rays), {"texels": texels})
    camera = torch.eye(3, dtype=given.dtype), torch.eye(4, dtype=given.dtype)

    def over(image: Tensor, alpha: Tensor, texels: Tensor) -> Tensor:
        return over_cube_map(image, alpha, CubeMap(texels, index), *camera, lambda: rays)

    yield "over_cube_map", (over, {"image": shown, "alpha": alpha[..., None], "texels": texels})


def of_gaussians(given: Given) -> Iterator[tuple[str, Operation]]:
    n = given.count
    means, quats, logs = given.uniform(n, 3), given.unit(n, 4), given.uniform(n, 3)
    logits, opacities, scales = given.uniform(n), given.uniform(n, low=0.1), given.uniform(n, 3, low=0.1)
    both = {"opacities": opacities, "scales": scales}
    yield "mean_opacity_and_scale", (lambda *values: mean_opacity_and_scale(values), both)
    yield "mean_thickness", (mean_thickness, {"scales": scales})
    cells = SparseGrid(torch.tensor([-5.0, -5.0]), 10.0, (1, 1), torch.zeros(1, dtype=torch.long))
    normal = normalize(torch.tensor([[0.1, 0.2, 1.0]], dtype=given.dtype), dim=1)
    road = Road(cells, normal, torch.zeros(1, dtype=given.dtype), torch.ones(1, dtype=given.dtype), reach=3.0)
    shapes = {"means": means, "quats": quats, "scales": scales}
    yield "road_distance", (lambda *values: road_distance(*values, opacities, road), shapes)
    sensor = torch.tensor([3.0, 0.0, 0.0], dtype=given.dtype)
    yield "lidar_response", (lambda logits: lidar_response(logits, means, sensor), {"logits": given.uniform(n, 4, 2)})
    radii, viewmats = torch.ones(1, n, 2, dtype=torch.int32), torch.eye(4, dtype=given.dtype)[None]
    far = means + torch.tensor([0.0, 0.0, 4.0], dtype=given.dtype)
    seen = {"means": far, "coefficients": 0.2 * given.uniform(n, 16, 3)}
    for degree in range(4):
        yield f"view_colors {degree}", (partial(view_colors, viewmats=viewmats, radii=radii, degree=degree), seen)
    owner, owns = owners(given)
    sizes, presence = given.uniform(3, low=0.5), torch.tensor([1.0, 0.0, 1.0], dtype=given.dtype)

    def placed(means: Tensor, quats: Tensor, logs: Tensor, logits: Tensor, turns: Tensor, shifts: Tensor) -> object:
        local = LocalGaussians(means, quats, logs, logits)
        return place(local, ObjectPoses(normalize(turns, dim=1), shifts, sizes, presence), owner, owns)

    local = {"means": means, "quats": quats, "logs": logs, "logits": logits}
    yield "place", (placed, {**local, "turns": given.unit(3, 4), "shifts": given.uniform(3, 3)})
    side = torch.where(torch.arange(n) % 2 == 0, 1.0, -1.0).to(given.dtype)
    yield "mirrored", (lambda *values: mirrored(LocalGaussians(*values), side), local)
    yield "of_owners", (lambda values: of_owners(values, owns), {"values": given.uniform(3, 2, 2)})
    series = torch.cat([torch.ones(3, 1, dtype=given.dtype), given.uniform(3, 4)], dim=1)
    colors = {"sh0": given.uniform(n, 5, 1, 3), "shN": given.uniform(n, 5, 3, 3)}
    yield "colors_in_object", (lambda sh0, shN: colors_in_object(sh0, shN, series, owns), colors)
    rotations = given.uniform(3, 4, 4)
    yield "colors_in_world", (lambda sh0, shN: colors_in_world(sh0, shN, series, rotations, owner, owns), colors)


def of_poses(given: Given) -> Iterator[tuple[str, Operation]]:
    n = given.count
    quats, vectors = given.unit(n, 4), given.uniform(n, 3)
    yield "rotation_matrix", (lambda quats: rotation_matrix(quats), {"quats": quats})
    yield "left_factor", (lambda quats: left_factor(quats), {"quats": quats})
    yield "rotated_back", (rotated_back, {"quats": quats, "vectors": vectors})
    yield "turned", (turned, {"quats": quats, "turns": vectors})
    yield "about_vertical", (about_vertical, {"angles": given.uniform(n)})
    annotations = 2 * n
    actor = torch.arange(annotations) // 2
    weights, translations = given.uniform(annotations, low=0.1), given.uniform(n, 3)
    yaw, shifts = given.uniform(annotations), given.uniform(annotations, 3)
    both = {"yaw": yaw, "shift": shifts}
    yield "corrected", (lambda *values: corrected(quats, translations, weights, actor, *values), both)
    triples = torch.stack([torch.arange(annotations - 2) + i for i in range(3)], dim=1) if n > 1 else None
    neighbours = torch.zeros(0, 3, dtype=torch.long) if triples is None else triples
    both = {"shifts": shifts, "yaw": yaw}
    yield "sums_of_squares", (lambda *values: sums_of_squares(*values, neighbours, 0.1, 0.03), both)


def operations(dtype: torch.dtype, count: int) -> dict[str, Operation]:
    return {
        name: operation
        for group in (of_images, of_gaussians, of_poses)
        for name, operation in group(Given(dtype, count))
    }


NAMES = [*operations(torch.float64, 5)]


def flat(outputs: object) -> list[Tensor]:
    """The tensors of what an operation returns."""
    return [outputs] if isinstance(outputs, Tensor) else [values for values in outputs if values is not None]


def gradients(operation: Operation) -> tuple[list[Tensor], dict[str, Tensor]]:
    """The outputs, and the gradients of a fixed combination of them."""
    function, inputs = operation
    given = {name: values.clone().requires_grad_() for name, values in inputs.items()}
    outputs = flat(function(*given.values()))
    total = sum((torch.cos(torch.arange(o.numel(), dtype=o.dtype)) * o.flatten()).sum() for o in outputs)
    found = torch.autograd.grad(total, [*given.values()], allow_unused=True, materialize_grads=True)
    return [o.detach() for o in outputs], dict(zip(given, found, strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_those_of_finite_differences(name):
    for count in (1, 5):
        function, inputs = operations(torch.float64, count)[name]
        given = [values.requires_grad_() for values in inputs.values()]
        assert torch.autograd.gradcheck(
            lambda *values, function=function: tuple(flat(function(*values))), given,
            eps=1e-6, atol=1e-5, rtol=1e-3, fast_mode=True,
        )  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_single_precision_agrees_with_double(name):
    double, single = (gradients(operations(dtype, 5)[name]) for dtype in (torch.float64, torch.float32))
    for exact, rounded in zip([*double[0], *double[1].values()], [*single[0], *single[1].values()], strict=True):
        assert rounded.dtype == torch.float32
        torch.testing.assert_close(rounded.double(), exact, rtol=1e-3, atol=1e-4 * float(exact.abs().max()) + 1e-6)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("ssim", "color_difference")])
def test_without_rows_gradients_are_empty(name):
    """An image has at least one pixel; those of alpha may be of no rays."""
    operation = operations(torch.float32, 0)[name]
    _, found = gradients(operation)
    for key, values in operation[1].items():
        assert found[key].shape == values.shape


SELECTIVE = {"mean_depth_error": ["depth"], "road_distance": ["means"], "view_colors 0": ["means"]}
"""Inputs of which NaN has no effect: the largest errors do not count, nor Gaussians that are not near the road; without
directions, places do not matter."""


@pytest.mark.parametrize("name", NAMES)
def test_nan_of_an_input_reaches_the_result(name):
    """A training sees it in its loss. Of a cube map all texels are NaN, since a few rays do not meet every one."""
    function, inputs = operations(torch.float64, 5)[name]
    for key, values in inputs.items():
        if key in SELECTIVE.get(name, ()):
            continue
        broken = values.clone()
        broken.view(-1)[: None if key == "texels" else 1] = torch.nan
        outputs = flat(function(*(inputs | {key: broken}).values()))
        assert any(bool(output.isnan().any()) for output in outputs), key
