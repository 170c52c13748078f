"""The static world: one set of Gaussians, fixed in world coordinates."""

import math

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.part import Part
from drivesplat.settings.gaussians import GaussianSettings

SH_C0 = 0.28209479177387814
"""The constant of the spherical harmonic of degree 0."""


class Background(Part):
    """Static Gaussians started from seed points: P `positions` (P, 3) metres and `colors` (P, 3) in [0, 1]."""

    name = "background"

    def __init__(self, params: dict[str, Tensor], settings: GaussianSettings, scene_scale: float):
        super().__init__()
        self.params = nn.ParameterDict(
            {key: nn.Parameter(value, requires_grad=value.numel() > 0) for key, value in params.items()}
        )
        self._settings = settings
        self._scene_scale = scene_scale

    @classmethod
    def from_points(
        cls, positions: np.ndarray, colors: np.ndarray, settings: GaussianSettings, scene_scale: float
    ) -> "Background":
        neighbours = min(4, len(positions))
        distances = cKDTree(positions).query(positions, k=neighbours, workers=-1)[0].reshape(len(positions), -1)[:, 1:]
        spacing = np.sqrt(np.mean(distances**2, axis=1)) if neighbours > 1 else np.ones(len(positions))
        scales = torch.from_numpy(np.log(np.maximum(spacing * settings.init_scale, 1e-4))).float()
        count = len(positions)
        params = {
            "means": torch.from_numpy(np.asarray(positions)).float(),
            "scales": scales[:, None].repeat(1, 3),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
            "opacities": torch.full((count,), math.log(settings.init_opacity / (1.0 - settings.init_opacity))),
            "sh0": ((torch.from_numpy(np.asarray(colors)).float() - 0.5) / SH_C0)[:, None, :],
            "shN": torch.zeros(count, (settings.sh_degree + 1) ** 2 - 1, 3),
        }
        return cls(params, settings, scene_scale)

    def at(self, time: float) -> Gaussians:
        p = self.params
        return Gaussians(
            p["means"],
            p["quats"],
            torch.exp(p["scales"]),
            torch.sigmoid(p["opacities"]),
            torch.cat([p["sh0"], p["shN"]], dim=1),
        )

    def learning_rates(self) -> dict[str, float]:
        s = self._settings
        rates = {"means": s.lr_means * self._scene_scale, "scales": s.lr_scales, "quats": s.lr_quats}
        return {**rates, "opacities": s.lr_opacities, "sh0": s.lr_sh0, "shN": s.lr_shN}
