"""A method's settings into a model: the only place that knows parts and skies by name."""

from typing import Any

import numpy as np
import torch

from drivesplat.model.background import Background
from drivesplat.model.part import Part, Sky
from drivesplat.model.sky import ConstantSky, CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.train import PartName, SkyKind, TrainSettings


def gaussian_cap(parser: dict[str, Any], settings: TrainSettings) -> int:
    """The most Gaussians a parser record's training images can hold: `cap_max`, or fewer where they have few pixels."""
    if not settings.pixels_per_gaussian:
        return settings.cap_max
    pixels = int(parser["image_sizes"][parser["splits"]["train"]].prod(axis=1).sum())
    return max(1, min(settings.cap_max, int(pixels / settings.pixels_per_gaussian)))


def build_model(
    parser: dict[str, Any], parts: tuple[PartName, ...], sky: SkyKind, settings: TrainSettings, sky_color: np.ndarray
) -> SplatModel:
    """An untrained model of a parser record. `sky_color` (3,) in [0, 1] starts the sky."""
    makers = {"background": _background}
    return SplatModel(
        [makers[name](parser, settings) for name in parts], _sky(sky, settings, sky_color), settings.antialiased
    )


def rebuild_model(
    state: dict[str, torch.Tensor],
    parts: tuple[PartName, ...],
    sky: SkyKind,
    settings: TrainSettings,
    scene_scale: float,
) -> SplatModel:
    """The model whose `state_dict` is `state`."""
    makers = {"background": Background}
    made = []
    for i, name in enumerate(parts):
        prefix = f"parts.{i}.params."
        params = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
        made.append(makers[name](params, settings.gaussians, scene_scale))
    model = SplatModel(made, _sky(sky, settings, np.full(3, 0.5)), settings.antialiased)
    model.load_state_dict(state)
    return model


def _background(parser: dict[str, Any], settings: TrainSettings) -> Part:
    positions, colors = parser["points"], parser["points_rgb"] / 255.0
    kept = slice(None)
    if len(positions) > settings.cap_max:
        kept = np.random.default_rng(0).choice(len(positions), settings.cap_max, replace=False)
    return Background.from_points(positions[kept], colors[kept], settings.gaussians, parser["scene_scale"])


def _sky(kind: SkyKind, settings: TrainSettings, color: np.ndarray) -> Sky | None:
    start = torch.as_tensor(color, dtype=torch.float32)
    if kind == "cubemap":
        return CubemapSky(settings.sky_resolution, start, settings.lr_sky)
    if kind == "mask":
        return ConstantSky(start, settings.lr_sky)
    return None
