"""The static world: one set of Gaussians, fixed in world coordinates."""

import numpy as np
import torch
from torch import Tensor

from drivesplat.model.gaussians import Gaussians, no_colors
from drivesplat.model.handover import Handover, are_alike, joined
from drivesplat.model.parameters import OFFSETS, init_params, learning_rates, make_parameters
from drivesplat.model.part import Part
from drivesplat.model.states import IMAGE, State, Want
from drivesplat.settings.train import GaussianSettings


class Background(Part):
    """Static Gaussians with an extent of `extent` metres."""

    name = "background"

    def __init__(self, params: dict[str, Tensor], settings: GaussianSettings, extent: float):
        super().__init__()
        self.params = make_parameters(params)
        self.extent = extent
        self._settings = settings

    @classmethod
    def from_points(
        cls,
        positions: np.ndarray,
        colors: np.ndarray,
        settings: GaussianSettings,
        extent: float,
        classes: int = 0,
        lidar_logits: tuple[float, float] | None = None,
        offsets: bool = False,
    ) -> "Background":
        """Initialised from seed points: `positions` (n, 3) metres and `colors` (n, 3) in [0, 1]; see `init_params`."""
        return cls(init_params(positions, colors, settings, classes, lidar_logits, offsets), settings, extent)

    def sample(self, state: State, want: Want = IMAGE) -> Gaussians:
        p = q = self.params
        if want.lidar and "lidar_means" in p:  # a LiDAR may see the geometry elsewhere than cameras do
            q = {name: p[name] + p[offset] for name, offset in OFFSETS.items()}
        return Gaussians(
            q["means"],
            q["quats"],
            torch.exp(q["scales"]),
            torch.sigmoid(q["opacities"]),
            *((p["sh0"], p["shN"]) if want.colors else no_colors(p["means"])),
            lidar_logits=p.get("lidar_logits") if want.lidar else None,
        )

    def take_over(self, other: Part, handover: Handover) -> None:
        if are_alike(self.params, other.params):
            spacing = torch.exp(self.params["scales"].detach()[:, 0]).numpy() / self._settings.init_scale
            rows = joined(self.params, handover.shifted(other.params), spacing, handover.cap_max)
            self.params = make_parameters(rows)

    def learning_rates(self) -> dict[str, float]:
        return learning_rates(self._settings, self.extent)
