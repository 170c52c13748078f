"""The road: flat Gaussians in its surface.

A road that is only seen along a line of cameras is explained by Gaussians above and below its surface as well as by
those in it, but only the latter look right from beside the line. Here position, rotation and extent within the surface
are learned, and the surface is given: it is that of LiDAR or of the vehicle's path, with small learned offsets.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from drivesplat.model.gaussians import Gaussians, no_colors
from drivesplat.model.height_field import HeightField
from drivesplat.model.parameters import fade, init_params, learning_rates, make_parameters
from drivesplat.model.part import Part, PartDefinition
from drivesplat.model.states import IMAGE, State, Want
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_geometry import RoadSettings

EDGE = 0.5
"""Metres between nodes of the surface."""
THICKNESS = 0.002
"""Standard deviation of its Gaussians across the surface (metres)."""
LARGEST = 0.5
"""Largest standard deviation in the surface (metres): where no image looks, longer ones reach into what is seen."""
INIT_SCALE, INIT_OPACITY = 0.6, 0.5
"""Initial standard deviations in units of the distance between neighbours, and initial opacity."""
ABOVE = 0.1
"""Metres above the surface within which there are no other static Gaussians."""


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
    `shared["offsets"]` (x, y) are what the nodes of the surface are raised by (metres).
    """

    name = "road"
    decaying = ("means", "offsets")

    def __init__(
        self,
        params: dict[str, Tensor],
        surface: HeightField,
        settings: RoadSettings,
        gaussians: GaussianSettings,
        extent: float,
        cap_max: int | None = None,
    ):
        super().__init__()
        self.params = make_parameters(params)
        self.extent = extent
        self.cap_max = cap_max
        for name in ("lower", "heights", "covered"):
            self.register_buffer(name, getattr(surface, name))
        self.shared["offsets"] = nn.Parameter(torch.zeros_like(surface.heights))
        self._settings = settings
        self._gaussians = gaussians

    @classmethod
    def from_seed(
        cls,
        seed: RoadSeed,
        settings: RoadSettings,
        gaussians: GaussianSettings,
        extent: float,
        classes: int = 0,
        lidar_logits: tuple[float, float] | None = None,
    ) -> "RoadPart":
        """Initialised from a seed, whose number of Gaussians densification keeps; see `init_params`."""
        faint = gaussians.model_copy(update={"init_opacity": INIT_OPACITY})
        params = init_params(seed.positions, seed.colors, faint, classes, lidar_logits)
        params["scales"] = torch.from_numpy(np.log(INIT_SCALE * seed.spacing)).float()[:, None].repeat(1, 3)
        return cls(params, seed.surface, settings, gaussians, extent, len(seed.positions))

    @property
    def surface(self) -> HeightField:
        """The surface with its learned offsets."""
        return HeightField(self.lower, EDGE, self.heights + self.shared["offsets"], self.covered)

    def sample(self, state: State, want: Want = IMAGE) -> Gaussians:
        p = self.params
        places = p["means"][:, :2]
        heights, slopes = self.surface.at(places)
        scales = torch.exp(p["scales"][:, :2]).clamp(max=LARGEST)
        return Gaussians(
            torch.cat([places, heights[:, None]], dim=1),
            _tilted(p["quats"], slopes.detach()),
            torch.cat([scales, torch.full_like(scales[:, :1], THICKNESS)], dim=1),
            torch.sigmoid(p["opacities"]),
            *((p["sh0"], p["shN"]) if want.colors else no_colors(p["means"])),
            lidar_logits=p.get("lidar_logits") if want.lidar else None,
        )

    def learning_rates(self) -> dict[str, float]:
        return {**learning_rates(self._gaussians, self.extent), "offsets": self._settings.lr_offsets}

    def definition(self) -> PartDefinition:
        return PartDefinition(self.name, self.extent)

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        own, offsets = self._settings, self.shared["offsets"]
        if not own.offsets_weight:
            return {}
        uneven = sum(offsets.diff(dim=axis).square().sum() for axis in (0, 1)) / EDGE**2
        return {"road_offsets": own.offsets_weight * (offsets.square().sum() + uneven) / offsets.numel()}

    @torch.no_grad()
    def confine(self) -> None:
        means, surface = self.params["means"], self.surface
        means[:, 2] = surface.at(means[:, :2]).heights
        fade(self.params, ~surface.covers(means[:, :2]))

    def owns(self, points: Float[Tensor, "n 3"]) -> Tensor:
        """Whether points (metres) lie where no static Gaussian of another part may be: (n,) bool."""
        surface = self.surface
        return replace(surface, heights=surface.heights.detach()).layer(points, self._settings.reach, ABOVE)


def _tilted(quats: Float[Tensor, "n 4"], slopes: Float[Tensor, "n 2"]) -> Float[Tensor, "n 4"]:
    """The rotations about the vertical of `quats`, followed by the shortest one that turns the vertical to the normals
    of surfaces with these slopes. The results have any length."""
    tilt = 1.0 + torch.sqrt(1.0 + slopes.square().sum(dim=1))
    (to_x, to_y), scalar, turn = slopes.unbind(dim=1), quats[:, 0], quats[:, 3]
    return torch.stack([tilt * scalar, to_y * scalar - to_x * turn, -to_x * scalar - to_y * turn, tilt * turn], dim=1)
