"""The plain recipe: the settings of gsplat's example trainer in its configuration `mcmc` (gsplat 1.5, examples/
simple_trainer.py), and its initial Gaussians.

It is the baseline of this workflow's training, so improvements there are not adopted here. It has two variants.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
import torch
from gsplat import MCMCStrategy
from scipy.spatial import cKDTree
from torch import Tensor, nn

from drivesplat.model.background import Background
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import GaussianSettings, TrainSettings

FULL_LENGTH = 30_000
"""The length of the example's schedule."""
RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
"""Learning rates; that of means is in units of the scene's scale."""
DECAY = 0.01
"""The last learning rate of means, as a fraction of their first."""
SCALE_MARGIN = 1.1
"""Factor from the extent of the cameras to the scene's scale."""
SH_DEGREE = 3
SH_C0 = 0.28209479177387814
INIT_OPACITY, INIT_SCALE = 0.5, 0.1
SSIM_WEIGHT = 0.2
OPACITY_REG = SCALE_REG = 0.01
WORKERS = 4
"""Processes that decode images."""
LOGGED_EVERY = 100
SAVED_AT = (7_000, 30_000)
MIN_SPACING = 1e-7
"""Minimum distance in metres that is assumed between seed points: the logarithm of a scale must be finite."""

PlainName = Literal["plain", "plain_packed", "plain_sky"]


class Variant(NamedTuple):
    """What a variant of the plain recipe changes: `packed`, the rasterizer's lists of visible Gaussians alone, and Adam
    for these alone (the example's options `packed` and `visible_adam`); `sky`, this workflow's sky behind them."""

    packed: bool = False
    sky: bool = False


PLAIN = Variant()
VARIANTS: Mapping[PlainName, Variant] = MappingProxyType(
    {"plain": PLAIN, "plain_packed": Variant(packed=True), "plain_sky": Variant(sky=True)}
)

Splats = nn.ParameterDict
Optimizers = dict[str, torch.optim.Optimizer]


@dataclass(frozen=True)
class Schedule:
    """The schedule of a training: the spherical harmonics gain a degree every `sh_every` iterations; between
    `refine_start` and `refine_stop` Gaussians are moved and added every hundredth iteration."""

    iterations: int
    sh_every: int
    refine_start: int
    refine_stop: int

    @classmethod
    def of(cls, iterations: int) -> "Schedule":
        """The example's schedule, shortened as its `steps_scaler` does, except for the hundred iterations between two
        refinements, which this workflow's trainings keep as well."""
        done = iterations / FULL_LENGTH
        return cls(iterations, max(1, int(1_000 * done)), int(500 * done), int(25_000 * done))

    @classmethod
    def continued(cls, iterations: int) -> "Schedule":
        """The schedule that continues a trained model: all degrees from the start, refinement to the end."""
        return cls(iterations, 1, 0, iterations)

    def sh_degree(self, step: int) -> int:
        """The degree of the spherical harmonics in a step."""
        return min(step // self.sh_every, SH_DEGREE)


@dataclass(frozen=True)
class PlainRecipe:
    """A training by a variant of the plain recipe, of at most `cap_max` Gaussians."""

    schedule: Schedule
    cap_max: int
    seed: int
    workers: int = WORKERS
    variant: Variant = PLAIN

    def strategy(self) -> MCMCStrategy:
        """gsplat's own densification."""
        return MCMCStrategy(
            cap_max=self.cap_max,
            refine_start_iter=self.schedule.refine_start,
            refine_stop_iter=self.schedule.refine_stop,
        )


def scene_scale(record: TrainingRecord) -> float:
    """The unit of the learning rate of means, in metres."""
    return SCALE_MARGIN * record.scene_scale


def init_splats(points: np.ndarray, colors: np.ndarray, seed: int) -> Splats:
    """Gaussians at seed points (n, 3) in metres with colours (n, 3) uint8, on the CPU, with random rotations."""
    torch.manual_seed(seed)
    count = len(points)
    distances = cKDTree(points).query(points, k=4, workers=-1)[0][:, 1:]
    spacing = np.maximum(np.sqrt((distances**2).mean(axis=1)), MIN_SPACING)
    coefficients = torch.zeros(count, (SH_DEGREE + 1) ** 2, 3)
    coefficients[:, 0] = (torch.from_numpy(colors / 255.0).float() - 0.5) / SH_C0
    values = {
        "means": torch.from_numpy(np.asarray(points)).float(),
        "scales": torch.from_numpy(np.log(spacing * INIT_SCALE)).float()[:, None].repeat(1, 3),
        "quats": torch.rand(count, 4),
        "opacities": torch.logit(torch.full((count,), INIT_OPACITY)),
        "sh0": coefficients[:, :1].clone(),
        "shN": coefficients[:, 1:].clone(),
    }
    return as_splats(values)


def as_splats(values: dict[str, Tensor]) -> Splats:
    """Tensors under gsplat's names as parameters."""
    return nn.ParameterDict({name: nn.Parameter(value) for name, value in values.items()})


def make_optimizers(splats: Splats, scale: float, variant: Variant = PLAIN) -> Optimizers:
    """An Adam for each parameter, as gsplat's strategies require; fused, as in later versions of the example. Packed,
    gsplat's own, which steps visible Gaussians alone."""
    units, same = {"means": scale}, {"eps": 1e-15, "betas": (0.9, 0.999)}
    groups = {name: [{"params": [splats[name]], "lr": rate * units.get(name, 1.0)}] for name, rate in RATES.items()}
    if variant.packed:
        from gsplat.optimizers import SelectiveAdam

        return {name: SelectiveAdam(group, **same) for name, group in groups.items()}
    return {name: torch.optim.Adam(group, fused=True, **same) for name, group in groups.items()}


def make_sky(variant: Variant, settings: TrainSettings) -> CubemapSky | None:
    """The sky of a variant, grey, with the resolution and learning rate of `settings`; None: black."""
    return CubemapSky(settings.sky_resolution, torch.full((3,), 0.5), settings.lr_sky) if variant.sky else None


def as_model(splats: Mapping[str, Tensor], extent: float, sky: CubemapSky | None = None) -> SplatModel:
    """Gaussians that spread over `extent` metres as a model of this workflow: a background before its sky, or before
    black. It shares their memory."""
    return SplatModel([Background(dict(splats), GaussianSettings(), extent)], sky)
