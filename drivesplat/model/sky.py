"""Skies: a learned cube map, or one learned colour.

The cube map's texels are the vertices of a grid on the cube: texels on an edge or corner are shared by the faces that
meet there, so that the colour is continuous over seams by construction.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from drivesplat.kernels.cube_map import CubeMap, cube_map_colors, over_cube_map, sampled
from drivesplat.model.part import Sky
from drivesplat.model.view import View


class ConstantSky(Sky):
    """One learned colour everywhere, started at `color` (3,) in [0, 1]."""

    keeps_gaussians_out = True

    def __init__(self, color: Float[Tensor, "3"], learning_rate: float):
        super().__init__()
        self.params = nn.ParameterDict({"color": nn.Parameter(logit_of(color))})
        self._learning_rate = learning_rate

    def colors(self, rays: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        return torch.sigmoid(self.params["color"]).expand_as(rays)

    def learning_rates(self) -> dict[str, float]:
        return {"color": self._learning_rate}


class CubemapSky(Sky):
    """A learned cube map of `resolution` texels along an edge, started at `color` (3,) in [0, 1]."""

    keeps_gaussians_out = False

    def __init__(self, resolution: int, color: Float[Tensor, "3"], learning_rate: float):
        super().__init__()
        index, count = shared_vertices(resolution)
        self.register_buffer("index", index, persistent=False)
        self.params = nn.ParameterDict({"texels": nn.Parameter(logit_of(color).repeat(count, 1))})
        self._learning_rate = learning_rate

    def colors(self, rays: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        return cube_map_colors(self._cube_map, rays)

    def behind(
        self,
        splats: Float[Tensor, "h w 3"],
        alpha: Float[Tensor, "h w 1"],
        view: View,
    ) -> Float[Tensor, "h w 3"]:
        return over_cube_map(
            splats, alpha, self._cube_map, view.K, view.camera_to_world, view.rays, view.turning_by_line
        )

    def directions(self) -> Float[Tensor, "n 3"]:
        """Where the texels lie, as vertices of a cube with edges of 2."""
        texels, resolution = self.params["texels"], self.index.shape[-1]
        directions = texels.new_zeros(len(texels), 3)
        directions[self.index] = (2.0 * _vertices(resolution) / (resolution - 1) - 1.0).to(texels)
        return directions

    def sums(self, rays: Float[Tensor, "h w 3"], values: Float[Tensor, "h w c"]) -> Float[Tensor, "n c"]:
        """The sums over an image of `values` by texel, with the weights of the bilinear interpolation."""
        with torch.enable_grad():  # the gradient of an interpolation is its transpose
            texels = values.new_zeros(len(self.params["texels"]), values.shape[-1], requires_grad=True)
            interpolated = sampled(texels, self.index, rays)
            return torch.autograd.grad((interpolated * values).sum(), texels)[0]

    @property
    def _cube_map(self) -> CubeMap:
        return CubeMap(self.params["texels"], self.index)

    def learning_rates(self) -> dict[str, float]:
        return {"texels": self._learning_rate}


def shared_vertices(resolution: int) -> tuple[Int[Tensor, "6 r r"], int]:
    """For every face texel (face, v, u) the index of its cube-surface vertex, and how many vertices there are."""
    x, y, z = _vertices(resolution).unbind(dim=-1)
    keys, index = torch.unique((x * resolution + y) * resolution + z, return_inverse=True)
    return index, len(keys)


def _vertices(resolution: int) -> Int[Tensor, "6 r r 3"]:
    """For every face texel (face, v, u) its vertex of the grid on the cube, from 0 to `resolution` - 1."""
    line = torch.arange(resolution)
    v, u = torch.meshgrid(line, line, indexing="ij")
    vertices = torch.zeros(6, resolution, resolution, 3, dtype=torch.long)
    for face, vertex in enumerate(vertices):
        axis = face // 2
        vertex[..., axis] = 0 if face % 2 else resolution - 1
        vertex[..., (axis + 1) % 3], vertex[..., (axis + 2) % 3] = u, v
    return vertices


def logit_of(color: Tensor) -> Tensor:
    """The logits of colours in [0, 1], limited to finite ones."""
    return torch.logit(color.clamp(0.02, 0.98))
