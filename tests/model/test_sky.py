"""Skies: a cube map without seams, and one colour."""

import itertools

import numpy as np
import pytest
import torch

from drivesplat.kernels.cube_map import face_coordinates, sampled
from drivesplat.model.sky import ConstantSky, CubemapSky, shared_vertices

AXES = {0: (1, 0, 0), 1: (-1, 0, 0), 2: (0, 1, 0), 3: (0, -1, 0), 4: (0, 0, 1), 5: (0, 0, -1)}
"""The outward normal of every face."""


def random_rays(seed: int, count: int) -> torch.Tensor:
    """Unit directions all over the sphere, as an image of one row."""
    rays = np.random.default_rng(seed).normal(size=(1, count, 3))
    return torch.from_numpy(rays / np.linalg.norm(rays, axis=-1, keepdims=True)).float()


def random_sky(resolution: int, seed: int = 0) -> CubemapSky:
    sky = CubemapSky(resolution, torch.full((3,), 0.5), 1e-2)
    with torch.no_grad():
        sky.params["texels"].normal_(generator=torch.Generator().manual_seed(seed))
    return sky


def surface_points(resolution: int) -> torch.Tensor:
    """Where texels (face, v, u) lie on the cube [-1, 1]^3 by the documented layout of the faces: (6, r, r, 3)."""
    line = torch.linspace(-1.0, 1.0, resolution)
    points = torch.zeros(6, resolution, resolution, 3)
    for face, normal in AXES.items():
        axis = face // 2
        points[face, ..., axis] = normal[axis]
        points[face, ..., (axis + 1) % 3] = line[None, :]
        points[face, ..., (axis + 2) % 3] = line[:, None]
    return points


@pytest.mark.parametrize("resolution", [2, 5])
def test_texels_are_the_vertices_of_a_grid_on_the_cube(resolution):
    """Faces share a texel exactly where they meet."""
    index, count = shared_vertices(resolution)
    assert count == 6 * resolution**2 - 12 * resolution + 8
    assert torch.equal(index.unique(), torch.arange(count))
    points = surface_points(resolution).reshape(-1, 3)
    same_place, same_texel = torch.cdist(points, points) < 1e-6, index.reshape(-1, 1) == index.reshape(1, -1)
    assert torch.equal(same_place, same_texel)
    assert torch.allclose(random_sky(resolution).directions()[index], surface_points(resolution), atol=1e-6)


def test_directions_with_gradient_have_the_same_face_coordinates():
    """A compiled pass serves those that are not; ties between axes fall alike."""
    rays = random_rays(4, 300)
    rays[0, 3:9] = torch.tensor([AXES[face] for face in range(6)], dtype=torch.float32)
    rays[0, :3] = torch.tensor([[1.0, -1.0, 1.0], [0.5, 0.5, 0.1], [0.1, -0.7, 0.7]])
    learned = rays.clone().requires_grad_()
    torch.testing.assert_close(face_coordinates(learned).detach(), face_coordinates(rays), atol=1e-6, rtol=0)
    assert face_coordinates(learned).requires_grad


@pytest.mark.parametrize("resolution", [2, 7])
def test_colours_lie_where_the_layout_says(resolution):
    """Bilinear interpolation is exact for a function that is linear on the cube's surface. Of rays of any length."""
    slope = torch.tensor([[0.9, -0.4, 0.2], [-0.7, 0.8, 0.1], [0.3, 0.5, -1.1]])
    sky = CubemapSky(resolution, torch.full((3,), 0.5), 1e-2)
    with torch.no_grad():
        sky.params["texels"][sky.index] = surface_points(resolution) @ slope
    rays = random_rays(2, 500)
    on_cube = rays / rays.abs().amax(dim=-1, keepdim=True)
    torch.testing.assert_close(sky.colors(37.0 * rays), torch.sigmoid(on_cube @ slope), rtol=0, atol=1e-5)


def edge_points() -> list[np.ndarray]:
    """Points on all twelve edges and eight corners of the cube."""
    points = [np.array(corner, dtype=float) for corner in itertools.product((-1.0, 1.0), repeat=3)]
    for axis in range(3):
        for first, second in itertools.product((-1.0, 1.0), repeat=2):
            for along in (-0.83, -0.31, 0.0, 0.27, 0.6):
                point = np.zeros(3)
                point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3] = along, first, second
                points.append(point)
    return points


def test_no_seam_shows_at_any_edge_or_corner():
    sky, aside = random_sky(8), np.array(list(itertools.product((-1e-6, 0.0, 1e-6), repeat=3)))
    around = torch.from_numpy(np.array(edge_points())[:, None] + aside).float()
    faces, colors = face_coordinates(around)[..., 2], sky.colors(around).detach()
    assert (faces.amax(dim=1) > faces.amin(dim=1)).all(), "the rays must fall on both sides of the seam"
    assert float((colors.amax(dim=1) - colors.amin(dim=1)).max()) < 1e-4


def test_every_texel_learns_from_an_all_round_view():
    sky = random_sky(4)
    sky.colors(random_rays(7, 5000)).sum().backward()
    assert (sky.params["texels"].grad > 0).all()


def test_a_new_cube_map_has_its_start_colour_in_all_directions():
    color = 0.2, 0.5, 0.9
    colors = CubemapSky(5, torch.tensor(color), 1e-2).colors(random_rays(8, 1000))
    torch.testing.assert_close(colors, torch.tensor(color).expand_as(colors), rtol=0, atol=1e-5)


def test_a_constant_sky_is_one_learned_colour():
    sky = ConstantSky(torch.tensor([0.2, 0.5, 0.9]), 3e-3)
    rays = random_rays(9, 50)
    torch.testing.assert_close(sky.colors(rays), torch.tensor([0.2, 0.5, 0.9]).expand(1, 50, 3), rtol=0, atol=1e-6)
    sky.colors(rays).sum().backward()
    expected = 50 * torch.tensor([0.2 * 0.8, 0.5 * 0.5, 0.9 * 0.1])
    torch.testing.assert_close(sky.params["color"].grad, expected)


@pytest.mark.parametrize("kind", ["constant", "cubemap"])
@pytest.mark.parametrize("color", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_a_black_or_white_start_can_still_learn(kind, color):
    start = torch.tensor(color)
    sky = ConstantSky(start, 1e-2) if kind == "constant" else CubemapSky(2, start, 1e-2)
    colors = sky.colors(random_rays(10, 20))
    assert float((colors - start).detach().abs().max()) < 0.03
    colors.sum().backward()
    (gradient,) = (value.grad for value in sky.params.values())
    assert torch.isfinite(gradient).all() and float(gradient.abs().max()) > 1e-3


def test_a_sky_learns_and_saves_its_colour_or_its_texels_alone():
    start = torch.full((3,), 0.5)
    for sky, name, size in ((ConstantSky(start, 3e-3), "color", 3), (CubemapSky(4, start, 3e-3), "texels", 56 * 3)):
        assert sky.learning_rates() == {name: 3e-3}
        assert {key: value.numel() for key, value in sky.state_dict().items()} == {f"params.{name}": size}


def test_sums_are_the_transpose_of_the_interpolation():
    sky, rays = random_sky(8), random_rays(1, 300)
    values = torch.from_numpy(np.random.default_rng(2).normal(size=(1, 300, 2))).float()
    texels = torch.from_numpy(np.random.default_rng(3).normal(size=(len(sky.params["texels"]), 2))).float()
    interpolated = sampled(texels, sky.index, rays)
    found = sky.sums(rays, values)
    assert torch.allclose((found * texels).sum(dim=0), (interpolated * values).sum(dim=(0, 1)), rtol=1e-4)
    assert torch.allclose(sky.sums(rays, torch.ones(1, 300, 1)).sum(), torch.tensor(300.0))
