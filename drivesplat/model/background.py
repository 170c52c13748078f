"""The static world: one set of Gaussians, fixed in world coordinates."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.model.gaussians import Gaussians, without_colors
from drivesplat.model.parameters import init_params, learning_rates, make_parameters
from drivesplat.model.part import Part
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
        echo: tuple[float, float] | None = None,
        offsets: bool = False,
    ) -> "Background":
        """Initialised from seed points: `positions` (n, 3) metres and `colors` (n, 3) in [0, 1]; see `init_params`."""
        return cls(init_params(positions, colors, settings, classes, echo, offsets), settings, extent)

    def time_state(self, time: float) -> Sequence[Tensor]:
        return ()

    def at_time_state(self, time_state: Sequence[Tensor]) -> Gaussians:
        p = self.params
        return Gaussians(
            p["means"],
            p["quats"],
            torch.exp(p["scales"]),
            torch.sigmoid(p["opacities"]),
            p["sh0"],
            p["shN"],
        )

    def seen_by_lidar(self, gaussians: Gaussians) -> Gaussians:
        return replace(gaussians, **self._offset()) if self._has_offsets else gaussians

    def scanned_at_time_state(self, time_state: Sequence[Tensor]) -> Gaussians:
        if not self._has_offsets:
            return super().scanned_at_time_state(time_state)
        return without_colors(**self._offset(), echoes=self.echoes_at_time_state(time_state))

    @property
    def _has_offsets(self) -> bool:
        """Whether a LiDAR sees its Gaussians elsewhere than cameras do."""
        return "lidar_means" in self.params

    def _offset(self) -> dict[str, Tensor]:
        """The fields of Gaussians that a LiDAR sees elsewhere than cameras do."""
        p = self.params
        return {
            "means": p["means"] + p["lidar_means"],
            "quats": p["quats"] + p["lidar_quats"],
            "scales": torch.exp(p["scales"] + p["lidar_scales"]),
            "opacities": torch.sigmoid(p["opacities"] + p["lidar_opacities"]),
        }

    def echoes_at_time_state(self, time_state: Sequence[Tensor]) -> Float[Tensor, "n 4 2"] | None:
        return self.params.get("echoes")

    def learning_rates(self) -> dict[str, float]:
        return learning_rates(self._settings, self.extent)
