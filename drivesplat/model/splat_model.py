"""A scene as a list of parts with a sky behind them, and how a camera sees it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from drivesplat.model.gaussians import concatenate
from drivesplat.model.part import Part, Sky
from drivesplat.rasterize import rasterize


@dataclass(frozen=True)
class View:
    """A camera at a time: `K` in continuous pixels, `time` in seconds since the first image."""

    K: Float[Tensor, "3 3"]
    camera_to_world: Float[Tensor, "4 4"]
    width: int
    height: int
    time: float

    @cached_property
    def viewmat(self) -> Float[Tensor, "4 4"]:
        """World to camera."""
        return torch.linalg.inv(self.camera_to_world)

    def rays(self) -> Float[Tensor, "h w 3"]:
        """The unit viewing direction of every pixel's centre in world coordinates."""
        x = torch.arange(self.width, device=self.K.device) + 0.5
        y = torch.arange(self.height, device=self.K.device) + 0.5
        grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        directions = torch.cat([(grid - self.K[:2, 2]) / self.K.diagonal()[:2], torch.ones_like(grid[..., :1])], dim=-1)
        return torch.nn.functional.normalize(directions @ self.camera_to_world[:3, :3].T, dim=-1)


@dataclass(frozen=True)
class Picture:
    """What a view shows: `image` with the sky behind, `alpha` of the Gaussians, `depth` in metres or None."""

    image: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"] | None
    info: dict[str, Any]


class SplatModel(nn.Module):
    """Parts and a sky (None: black)."""

    def __init__(self, parts: Sequence[Part], sky: Sky | None, antialiased: bool = False):
        super().__init__()
        self.parts = nn.ModuleList(parts)
        self.sky = sky
        self.antialiased = antialiased

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    def render(
        self, view: View, sh_degree: int, *, absgrad: bool = False, with_depth: bool = False, rays: Tensor | None = None
    ) -> Picture:
        """The view, with spherical harmonics up to `sh_degree`.

        `rays` (h, w, 3) saves computing `view.rays()` again.
        """
        gaussians = concatenate([part.at(view.time) for part in self.parts])
        rendering = rasterize(
            gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh,
            view.viewmat[None], view.K[None], view.width, view.height,
            sh_degree=sh_degree, antialiased=self.antialiased, absgrad=absgrad, with_depth=with_depth,
        )  # fmt: skip
        image, alpha = rendering.image[0], rendering.alpha[0]
        if self.sky is not None:
            image = image + (1.0 - alpha) * self.sky.colors(view.rays() if rays is None else rays)
        depth = rendering.depth[0, ..., 0] if rendering.depth is not None else None
        return Picture(image, alpha[..., 0], depth, rendering.info)
