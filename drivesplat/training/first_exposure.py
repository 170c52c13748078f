"""How cameras expose, before anything is trained: from surfaces that several of them recorded.

A training alone would hardly come to it: what one camera alone has seen takes on that camera's colours at once and from
then on speaks for its exposure as it is.
"""

import logging
from collections.abc import Sequence

import numpy as np

from drivesplat.lidar.coloring import visible
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.training.views import TrainingView

log = logging.getLogger(__name__)

LEAST_SHARED = 50
"""Points that a camera shares with others, from which on their colours tell of its exposure."""
LEVELS = (8, 247)
"""Between these grey levels a pixel is neither clipped nor noise."""
ROUNDS = 8
"""How often every camera is compared anew with the others: a rig of six is joined in three."""


def first_gains(
    record: TrainingRecord, views: Sequence[TrainingView], cameras: Sequence[str], reference: str
) -> dict[str, np.ndarray]:
    """The gain (3,) of every colour channel of each of `cameras` over the reference camera, by the seed points that lie
    on surfaces; 1 for a camera that shares too few with the others. `views` are the training images."""
    surfaces = record.points[: len(record.points) - record.seed.far]
    shades = log_colors(surfaces, views, [reference, *cameras])
    gains = np.exp(log_gains(shades))
    for camera, gain in zip(cameras, gains[1:], strict=True):
        log.info("%s: gains of %.2f, %.2f, %.2f over %s", camera, *gain, reference)
    return dict(zip(cameras, gains[1:], strict=True))


def log_colors(points: np.ndarray, views: Sequence[TrainingView], cameras: Sequence[str]) -> np.ndarray:
    """The logarithm of the mean colour (c, n, 3) that each of `cameras` recorded of world points (n, 3); NaN where a
    camera saw none of a point, or saw it clipped or in the dark. The own car hides what is behind it."""
    sums, counts = np.zeros((len(cameras), len(points), 3)), np.zeros((len(cameras), len(points), 1))
    for view in (view for view in views if view.view.camera in cameras):
        camera, shape = cameras.index(view.view.camera), (view.view.height, view.view.width)
        at = view.view.viewmat.double().cpu().numpy(), view.view.K.double().cpu().numpy()
        index, rows, columns, _ = visible(points.astype(np.float64), *at, shape)
        colors = view.pixels.cpu().numpy()[rows, columns]
        told = ((colors > LEVELS[0]) & (colors < LEVELS[1])).all(axis=1)
        if view.own_car is not None:
            told &= ~view.own_car.cpu().numpy()[rows, columns]
        sums[camera, index[told]] += colors[told]
        counts[camera, index[told]] += 1
    return np.log(np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0) / 255.0)


def log_gains(shades: np.ndarray) -> np.ndarray:
    """The log gain (c, 3) of each camera over the first, where log colours (c, n, 3) are a surface's plus the camera's
    gain: by turns the median of how far a camera's lie over those of the cameras known so far. 0 where too few points
    are shared."""
    gains = np.full((len(shades), 3), np.nan)
    gains[0] = 0.0
    for _ in range(ROUNDS):
        for camera in range(1, len(shades)):
            others = [i for i in range(len(shades)) if i != camera and np.isfinite(gains[i, 0])]
            surfaces = shades[others] - gains[others, None]
            seen = np.isfinite(surfaces[..., 0])
            known = np.where(seen[..., None], surfaces, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None]
            shared = seen.any(axis=0) & np.isfinite(shades[camera, :, 0])
            if shared.sum() >= LEAST_SHARED:
                gains[camera] = np.median(shades[camera, shared] - known[shared], axis=0)
    return np.nan_to_num(gains)
