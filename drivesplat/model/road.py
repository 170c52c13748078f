"""The road: flat Gaussians in its surface.

A road that is only seen along a line of cameras is explained by Gaussians above and below its surface as well as by
those in it, but only the latter look right from beside the line. Here position, rotation and extent within the surface
are learned, and the surface is given: it is that of LiDAR or of the vehicle's path. Learned heights were worse, in
synthetic worlds by pixels from 2 m aside (docs/tried.md).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import avg_pool2d

from drivesplat.model.gaussians import Gaussians, no_colors
from drivesplat.model.handover import Handover, are_alike, joined
from drivesplat.model.height_field import HeightField, bilinear
from drivesplat.model.parameters import fade, init_params, learning_rates, make_parameters
from drivesplat.model.part import Part
from drivesplat.model.states import IMAGE, State, Want
from drivesplat.settings.train import GaussianSettings

EDGE = 0.5
"""Metres between nodes of the surface."""
THICKNESS = 0.002
"""Standard deviation of its Gaussians across the surface (metres)."""
LARGEST = 0.5
"""Largest standard deviation in the surface (metres): where no image looks, longer ones reach into what is seen."""
VISIBLE, FILLED_OPACITY, FILLED_SCALE = 0.3, 3.0, 0.3
"""Of `gap_fillers`: the opacity from which a Gaussian is visible; of those that it adds the opacity (logit), and the
standard deviation in units of EDGE, half of which is the distance between them."""
INIT_SCALE, INIT_OPACITY = 0.4, 0.5
"""Initial standard deviations in units of the distance between neighbours, and initial opacity."""
BELOW, ABOVE = 0.3, 0.1
"""Metres below and above the surface within which there are no other static Gaussians."""


@dataclass(frozen=True)
class RoadSeed:
    """The `surface` of a road, on the CPU, and n initial Gaussians on it: `positions` (world metres), the `spacing`
    (metres) between neighbours, and `colors` in [0, 1]."""

    surface: HeightField
    positions: Float[np.ndarray, "n 3"]
    spacing: Float[np.ndarray, " n"]
    colors: Float[np.ndarray, "n 3"]


class RoadPart(Part):
    """n Gaussians in a surface with an extent of `extent` metres.

    Of `params["means"]` (n, 3), metres, the first two columns are learned; the third follows from the surface, and is
    brought up to date by `confine`. Of `quats` only turns about the normal have an effect, of `scales` the first two.
    """

    name = "road"

    def __init__(
        self,
        params: dict[str, Tensor],
        surface: HeightField,
        settings: GaussianSettings,
        extent: float,
        cap_max: int | None = None,
    ):
        super().__init__()
        self.params = make_parameters(params)
        self.extent = extent
        self.cap_max = cap_max
        for name in ("lower", "heights", "covered"):
            self.register_buffer(name, getattr(surface, name))
        self.register_buffer("tiles", surface.tiles(), persistent=False)
        self.register_buffer("turns", _turns(self.tiles, EDGE), persistent=False)
        self._settings = settings

    @classmethod
    def from_seed(
        cls,
        seed: RoadSeed,
        settings: GaussianSettings,
        extent: float,
        classes: int = 0,
        lidar_logits: tuple[float, float] | None = None,
    ) -> "RoadPart":
        """Initialised from a seed, whose number of Gaussians densification keeps; see `init_params`."""
        opaque = settings.model_copy(update={"init_opacity": INIT_OPACITY})
        params = init_params(seed.positions, seed.colors, opaque, classes, lidar_logits)
        params["scales"] = torch.from_numpy(np.log(INIT_SCALE * seed.spacing)).float()[:, None].repeat(1, 3)
        return cls(params, seed.surface, settings, extent, len(seed.positions))

    @property
    def surface(self) -> HeightField:
        """The surface that its Gaussians lie in."""
        return HeightField(self.lower, EDGE, self.heights, self.covered)

    def sample(self, state: State, want: Want = IMAGE) -> Gaussians:
        p = self.params
        places = p["means"][:, :2]
        cells, inside = self.surface.locate(places)
        heights, turns = bilinear(self.tiles.index_select(0, cells), inside), self.turns.index_select(0, cells)
        scales = torch.exp(p["scales"][:, :2]).clamp(max=LARGEST)
        return Gaussians(
            torch.cat([places, heights[:, None]], dim=1),
            (p["quats"][:, ::3, None] * turns).sum(dim=1),
            torch.cat([scales, torch.full_like(scales[:, :1], THICKNESS)], dim=1),
            torch.sigmoid(p["opacities"]),
            *((p["sh0"], p["shN"]) if want.colors else no_colors(p["means"])),
            lidar_logits=p.get("lidar_logits") if want.lidar else None,
        )

    def take_over(self, other: Part, handover: Handover) -> None:
        if are_alike(self.params, other.params):
            spacing = torch.exp(self.params["scales"].detach()[:, 0]).numpy() / INIT_SCALE
            learned = handover.shifted(other.params)
            on_road = self.surface.covers(learned["means"][:, :2])
            learned = {name: values[on_road] for name, values in learned.items()}
            self.params = make_parameters(joined(self.params, learned, spacing, self.row_count))
            self.confine()

    def learning_rates(self) -> dict[str, float]:
        return learning_rates(self._settings, self.extent)

    @torch.no_grad()
    def confine(self) -> None:
        means, surface = self.params["means"], self.surface
        means[:, 2] = surface.at(means[:, :2])
        fade(self.params, ~surface.covers(means[:, :2]))

    @torch.no_grad()
    def gap_fillers(self) -> dict[str, Tensor]:
        """Further rows of `params`: opaque Gaussians in covered cells of which its own hide less than half, copies of
        the nearest visible ones in all but place and shape."""
        p, surface = self.params, self.surface
        opacities, scales = torch.sigmoid(p["opacities"]), torch.exp(p["scales"][:, :2])
        areas = 2.0 * math.pi * opacities * scales.prod(dim=1)
        hidden = 1.0 - torch.exp(-surface.sums(p["means"][:, :2], areas) / EDGE**2)
        around = avg_pool2d(hidden[None], 3, stride=1, padding=1)[0]  # large Gaussians reach into cells beside theirs
        visible = (opacities > VISIBLE).nonzero()[:, 0]
        cells = (surface.covered & (torch.maximum(hidden, around) < 0.5)).nonzero()[: None if len(visible) else 0]
        inside = torch.cartesian_prod(*[torch.tensor([0.25, 0.75], device=cells.device)] * 2)
        places = self.lower + EDGE * (cells[:, None] + inside).reshape(-1, 2)
        nearest = cKDTree(p["means"][visible, :2].cpu().numpy()).query(places.cpu().numpy())[1]
        rows = visible[torch.from_numpy(nearest).to(visible.device)]
        found = {name: values[rows].clone() for name, values in p.items()}
        found["means"] = torch.cat([places, surface.at(places)[:, None]], dim=1)
        found["scales"].fill_(math.log(FILLED_SCALE * EDGE))
        found["opacities"].fill_(FILLED_OPACITY)
        return found

    def extend(self, rows: dict[str, Tensor], beyond: int) -> None:
        """Replaces all rows of `params` `beyond` so many by others."""
        own = {name: values.detach()[:beyond] for name, values in self.params.items()}
        self.params = make_parameters({name: torch.cat([own[name], rows[name]]) for name in own})

    def owns(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Whether points (metres) lie where no static Gaussian of another part may be."""
        return in_layer(self.surface, points)


def in_layer(surface: HeightField, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Whether points (metres) lie in the layer of a road with this surface."""
    return surface.layer(points, BELOW, ABOVE)


def _turns(tiles: Float[Tensor, "cells 4"], edge: float) -> Float[Tensor, "cells 2 4"]:
    """Quaternions (w, x, y, z) of any length: with a rotation (w, 0, 0, z) about the vertical, w times the first of a
    cell plus z times the second is this rotation, followed by the shortest one that turns the vertical to the surface's
    normal in the middle of the cell."""
    _, in_x, in_y, both = tiles.unbind(dim=1)
    to_x, to_y = (in_x + 0.5 * both) / edge, (in_y + 0.5 * both) / edge
    tilt, nothing = 1.0 + torch.sqrt(1.0 + to_x.square() + to_y.square()), torch.zeros_like(to_x)
    first, second = [tilt, to_y, -to_x, nothing], [nothing, -to_x, -to_y, tilt]
    return torch.stack([torch.stack(first, dim=1), torch.stack(second, dim=1)], dim=1)
