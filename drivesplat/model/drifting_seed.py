"""Initial values of drifting Gaussians, from the poses of training images alone.

Nothing is known of moving objects, so these are hypotheses: at random places near the ground that a training image
shows, at its time, with velocities like those of traffic along the ego vehicle's path. Those that no image supports
fade, and densification moves them, velocities and life peaks included, to those that images support.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.drifting import DriftingSeedSettings

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
