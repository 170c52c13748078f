"""Moving things without boxes: Gaussians that drift through the world and live for a while.

After Periodic Vibration Gaussian (Chen et al. 2023, arXiv 2311.18561): each Gaussian has a velocity v, a life peak tau
and a life span beta. At time t its opacity is its own times exp(-0.5 ((t - tau) / beta)²). Its centre is at
mean + (t - tau) v: PVG's vibration, l / (2 pi) sin(2 pi (t - tau) / l) v, in the limit of a long cycle l. Vibrating
Gaussians return, so that PVG can represent the static world with them, too; here the background does that.

Initial values follow from the poses of training images alone. Nothing is known of moving objects, so these are
hypotheses: at random places near the ground that a training image shows, at its time, with velocities like those of
traffic along the ego vehicle's path. Those that no image supports fade, and densification moves them, velocities and
life peaks included, to those that images support.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.model.gaussians import Gaussians, no_colors
from drivesplat.model.parameters import init_params, learning_rates, make_parameters
from drivesplat.model.part import GEOMETRY, Part, PartDefinition, RigidGroup
from drivesplat.model.states import IMAGE, State, Want
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.drifting import DriftingSeedSettings, DriftingSettings
from drivesplat.settings.train import GaussianSettings

LIFE_ENDS = 3.0
"""Life spans from its peak after which a Gaussian is absent: its opacity is 1 % of that at the peak."""
ANGULAR_SIZE = 0.02
"""Initial scale of a seed Gaussian per metre of distance from its camera."""


@dataclass(frozen=True)
class DriftingSeed:
    """n initial Gaussians: `positions` (world metres), `velocities` (m/s), life `peaks` (seconds since the first
    image), `colors` in [0, 1], and `scales` (metres)."""

    positions: Float[np.ndarray, "n 3"]
    velocities: Float[np.ndarray, "n 3"]
    peaks: Float[np.ndarray, " n"]
    colors: Float[np.ndarray, "n 3"]
    scales: Float[np.ndarray, " n"]


class Drifting(Part):
    """n Gaussians that move at constant velocities through a scene with an extent of `extent` metres.

    `params["means"]` (n, 3) are their centres at their life peaks `peaks` (n,) in seconds since the first image,
    `velocities` (n, 3) are in m/s, and `spans` (n,) logarithms of the seconds by which life spans exceed the minimum
    of the settings. `seconds` are the times of the first and the last training image: beyond them Gaussians go on
    moving, but neither appear nor fade.
    """

    name = "drifting"
    moves = True
    geometry = (*GEOMETRY, "velocities", "peaks", "spans")
    decaying = ("means", "velocities")

    def __init__(
        self,
        params: dict[str, Tensor],
        settings: DriftingSettings,
        gaussians: GaussianSettings,
        extent: float,
        seconds: tuple[float, float],
        cap_max: int | None = None,
    ):
        super().__init__()
        self.params = make_parameters(params)
        self.extent = extent
        self.cap_max = cap_max
        self._seconds = seconds
        self._settings = settings
        self._gaussians = gaussians

    @classmethod
    def from_seed(
        cls,
        seed: DriftingSeed,
        settings: DriftingSettings,
        gaussians: GaussianSettings,
        extent: float,
        seconds: tuple[float, float],
        classes: int = 0,
        lidar_logits: tuple[float, float] | None = None,
    ) -> "Drifting":
        """Initialised from a seed of a `settings.seed.fraction` of its maximum number; see `init_params`."""
        own, count = settings.seed, len(seed.positions)
        start = gaussians.model_copy(update={"init_opacity": own.opacity})
        span = math.log(max(own.span - settings.min_span, 0.01 * settings.min_span))
        params = {
            **init_params(seed.positions, seed.colors, start, classes, lidar_logits),
            "scales": torch.from_numpy(np.log(seed.scales)).float()[:, None].repeat(1, 3),
            "velocities": torch.from_numpy(seed.velocities).float(),
            "peaks": torch.from_numpy(seed.peaks).float(),
            "spans": torch.full((count,), span),
        }
        return cls(params, settings, gaussians, extent, seconds, max(count, round(count / own.fraction)))

    def state(self, time: float, want: Want = IMAGE) -> State:
        """The time, and the time that decides on opacities."""
        means, (first, last) = self.params["means"], self._seconds
        return State((means.new_full((), time), means.new_full((), min(max(time, first), last))))

    def sample(self, state: State, want: Want = IMAGE) -> Gaussians:
        p = self.params
        time, lived = state.now
        return Gaussians(
            p["means"] + (time - p["peaks"])[:, None] * p["velocities"],
            p["quats"],
            torch.exp(p["scales"]),
            self._opacities(lived),
            *((p["sh0"], p["shN"]) if want.colors else no_colors(p["means"])),
            velocities=p["velocities"].detach() if want.velocities else None,
            lidar_logits=p.get("lidar_logits") if want.lidar else None,
        )

    def _opacities(self, time: Float[Tensor, ""]) -> Float[Tensor, " n"]:
        ages = (time - self.params["peaks"]) / self.life_spans
        life = torch.where(ages.abs() >= LIFE_ENDS, 0.0, torch.exp(-0.5 * ages.square()))  # NaN stays NaN
        return torch.sigmoid(self.params["opacities"]) * life

    @property
    def life_spans(self) -> Float[Tensor, " n"]:
        """The life span of each Gaussian in seconds."""
        return self._settings.min_span + torch.exp(self.params["spans"])

    def learning_rates(self) -> dict[str, float]:
        own = self._settings
        rates = {"means": own.lr_means, "velocities": own.lr_velocities, "peaks": own.lr_peaks, "spans": own.lr_spans}
        return {**learning_rates(self._gaussians, self.extent), **rates}

    def definition(self) -> PartDefinition:
        return PartDefinition(self.name, self.extent, seconds=self._seconds)

    @torch.no_grad()
    def rigid_groups(self, time: float) -> dict[str, RigidGroup]:
        """Those that are present at the time, as one static group."""
        gaussians = self.sample(self.state(time))
        return {self.name: RigidGroup(gaussians[gaussians.opacities != 0], None)}


def drifting_seed(
    record: TrainingRecord, settings: DriftingSeedSettings, count: int, random: np.random.Generator
) -> DriftingSeed:
    """`count` initial Gaussians for a record with training images."""
    images = np.array(record.train_images)
    times = np.array([record.seconds(int(i)) for i in images])
    chosen = random.integers(len(images), size=count)
    depths = np.exp(random.uniform(*np.log(settings.depths), size=count))
    own = images[chosen]
    positions = record.camtoworlds[own][:, :3, 3] + depths[:, None] * _directions(record, own, random)
    positions[:, 2] = record.ego_to_world[own][:, 2, 3] + random.uniform(0.0, settings.height, size=count)
    velocities = ego_velocities(record, images)[chosen] * random.uniform(*settings.speeds, size=(count, 1))
    velocities[:, :2] += settings.spread * random.normal(size=(count, 2))
    apart = np.diff(np.unique(times))
    peaks = times[chosen] + random.uniform(-0.5, 0.5, size=count) * (np.median(apart) if len(apart) else 0.0)
    color = record.points_rgb.mean(axis=0) / 255.0 if len(record.points_rgb) else np.full(3, 0.5)
    return DriftingSeed(positions, velocities, peaks, np.tile(color, (count, 1)), ANGULAR_SIZE * depths)


def ego_velocities(record: TrainingRecord, images: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m 3"]:
    """The velocities (m/s) of the ego vehicle at the times of images, by differences between them; 0 if all have the
    same time."""
    times = np.array([record.seconds(int(i)) for i in images])
    distinct, first = np.unique(times, return_index=True)
    if len(distinct) < 2:
        return np.zeros((len(images), 3))
    velocities = np.gradient(record.ego_to_world[images[first]][:, :3, 3], distinct, axis=0)
    return velocities[np.searchsorted(distinct, times)]


def _directions(
    record: TrainingRecord, images: Int[np.ndarray, " n"], random: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """The viewing directions (world) of a random column of each image, one metre along the camera's axis."""
    K, columns = record.Ks[images], random.uniform(0.0, record.image_sizes[images][:, 0])
    in_camera = np.stack([(columns - K[:, 0, 2]) / K[:, 0, 0], np.zeros(len(K)), np.ones(len(K))], axis=1)
    return np.einsum("nij,nj->ni", record.camtoworlds[images][:, :3, :3], in_camera)
