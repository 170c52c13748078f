"""Initial exposures of cameras, estimated before the training from surfaces that several cameras recorded.

Training alone hardly corrects them: Gaussians seen by one camera soon take on its colours, and then confirm its
exposure.
"""

import logging
from collections.abc import Sequence

import numpy as np

from drivesplat.lidar.coloring import visible
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.training.views import TrainingView

log = logging.getLogger(__name__)

MIN_SHARED_POINTS = 50
"""Minimum number of points shared with other cameras for an estimate."""
VALID_LEVELS = (8, 247)
"""Levels between which a pixel is neither clipped nor noise."""
ROUNDS = 8
"""Number of passes over all cameras; three connect a rig of six."""


def initial_gains(
    record: TrainingRecord, views: Sequence[TrainingView], cameras: Sequence[str], reference: str
) -> dict[str, np.ndarray]:
    """The gains (3,) of the colour channels of each of `cameras` relative to the reference camera, by the seed points
    on surfaces; 1 for a camera that shares too few points. `views` are the training images."""
    surfaces = record.points[: len(record.points) - record.seed.far]
    observed = log_colors(surfaces, views, [reference, *cameras])
    gains = np.exp(log_gains(observed))
    for camera, gain in zip(cameras, gains[1:], strict=True):
        log.info("%s: gains of %.2f, %.2f, %.2f over %s", camera, *gain, reference)
    return dict(zip(cameras, gains[1:], strict=True))


def log_colors(points: np.ndarray, views: Sequence[TrainingView], cameras: Sequence[str]) -> np.ndarray:
    """The logarithm of the mean colour (c, n, 3) that each of `cameras` recorded of world points (n, 3); NaN where a
    camera did not see a point, or not between VALID_LEVELS. Pixels of the ego vehicle are ignored."""
    sums, counts = np.zeros((len(cameras), len(points), 3)), np.zeros((len(cameras), len(points), 1))
    for view in (view for view in views if view.view.camera in cameras):
        camera, shape = cameras.index(view.view.camera), (view.view.height, view.view.width)
        at = view.view.viewmat.double().cpu().numpy(), view.view.K.double().cpu().numpy()
        index, rows, columns, _ = visible(points.astype(np.float64), *at, shape)
        colors = view.pixels.cpu().numpy()[rows, columns]
        valid = ((colors > VALID_LEVELS[0]) & (colors < VALID_LEVELS[1])).all(axis=1)
        if view.ego_mask is not None:
            valid &= ~view.ego_mask.cpu().numpy()[rows, columns]
        sums[camera, index[valid]] += colors[valid]
        counts[camera, index[valid]] += 1
    return np.log(np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0) / 255.0)


def log_gains(observed: np.ndarray) -> np.ndarray:
    """The log gain (c, 3) of each camera relative to the first, where `observed` log colours (c, n, 3) are those of the
    surface plus the log gain of the camera. Iterates over cameras: the median difference to the mean of the cameras
    known so far. 0 where too few points are shared."""
    gains = np.full((len(observed), 3), np.nan)
    gains[0] = 0.0
    for _ in range(ROUNDS):
        for camera in range(1, len(observed)):
            others = [i for i in range(len(observed)) if i != camera and np.isfinite(gains[i, 0])]
            surfaces = observed[others] - gains[others, None]
            seen = np.isfinite(surfaces[..., 0])
            known = np.where(seen[..., None], surfaces, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None]
            shared = seen.any(axis=0) & np.isfinite(observed[camera, :, 0])
            if shared.sum() >= MIN_SHARED_POINTS:
                gains[camera] = np.median(observed[camera, shared] - known[shared], axis=0)
    return np.nan_to_num(gains)
