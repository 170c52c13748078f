"""Initial exposures, estimated before the training from surfaces: of cameras, from those that several of them
recorded, and over time, from those that several images of a camera show.

Training alone hardly corrects them: Gaussians seen by one camera, or for a short time, soon take on its colours, and
then confirm its exposure.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from drivesplat.io.prefetch import prefetch
from drivesplat.lidar.coloring import visible
from drivesplat.model.exposure import GainCurve
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.training.views import TrainingView

log = logging.getLogger(__name__)

MIN_SHARED_POINTS = 50
"""Minimum number of points shared with other cameras for an estimate."""
MAX_POINTS = 100_000
"""More seed points are thinned evenly to at most so many."""
DISTANCE_STEP = 0.1
"""Width of the intervals of distance within which colours are compared (natural logarithm)."""
VALID_LEVELS = (8, 247)
"""Levels between which a pixel is neither clipped nor noise."""
ROUNDS = 8
"""Number of passes over all cameras; three connect a rig of six."""
CURVE_POINTS = 30_000
"""Of more seed points, exposures over time are estimated from at most so many."""
NEXT_IMAGES = (1, 2, 4, 8, 16)
"""Images of a camera are compared with those so many images later."""
DISTANCE_GROUPS = 4
"""Groups into which the points of two images are split by how their distance changes."""
DRIFT = 0.25
"""Changes of log gains per second up to this are left out, and those of twice as much kept whole. What comes nearer
changes its colour, too: on a recorded drive with sparse LiDAR by up to 0.3 per second, where no exposure changed so. An
automatic exposure changes by 0.5 to 1 per second where light and shade meet."""
MIN_CURVE = 0.1
"""Smallest deviation of log gains from their mean for which exposures are said to change over time."""
TIE = 1e-4
"""Weight of log gains of 0, relative to that of all comparisons with an image: it fixes their mean, and the gains of
images that share no surface with others."""


class Sightings(NamedTuple):
    """m sightings of points by a camera: `point` (m,), the index of each, `distance` (m,) in metres, and `color` (m, 3)
    in levels of 0 to 255."""

    point: np.ndarray
    distance: np.ndarray
    color: np.ndarray


def initial_gains(
    record: TrainingRecord, views: Sequence[TrainingView], cameras: Sequence[str], reference: str
) -> dict[str, np.ndarray]:
    """The gains (3,) of the colour channels of each of `cameras` relative to the reference camera, by the seed points
    on surfaces; 1 for a camera that shares too few points. `views` are the training images.

    Colours are compared between images that show a point from about the same distance, since haze brightens what is far
    away: a camera that looks ahead sees a facade from farther away than one that looks aside, whose gain would come out
    too small. Cameras that share too few such points are compared at any distance.
    """
    seen = sightings(_surfaces(record, MAX_POINTS), views, [reference, *cameras])
    gains = np.full((1 + len(cameras), 3), np.nan)
    gains[0] = 0.0
    for step in (DISTANCE_STEP, math.inf):
        if np.isnan(gains).any():
            gains = log_gains(log_colors(seen, step), gains)
    found = np.exp(np.nan_to_num(gains))
    for camera, gain in zip(cameras, found[1:], strict=True):
        log.info("%s: gains of %.2f, %.2f, %.2f over %s", camera, *gain, reference)
    return dict(zip(cameras, found[1:], strict=True))


def _surfaces(record: TrainingRecord, at_most: int) -> np.ndarray:
    """The seed points (n, 3) on surfaces, thinned evenly."""
    surfaces = record.points[: len(record.points) - record.seed.far]
    return surfaces[:: max(1, math.ceil(len(surfaces) / at_most))].astype(np.float64)


def sightings(points: np.ndarray, views: Sequence[TrainingView], cameras: Sequence[str]) -> list[Sightings]:
    """What each of `cameras` saw of world points (n, 3). Pixels of the ego vehicle and those outside VALID_LEVELS are
    left out."""
    found: dict[str | None, list[Sightings]] = {camera: [] for camera in cameras}
    chosen = [view for view in views if view.view.camera in found]
    for view, own in zip(chosen, _sightings_of(points, chosen), strict=True):
        found[view.view.camera].append(own)
    nothing = Sightings(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)))
    return [Sightings(*(np.concatenate(values) for values in zip(nothing, *found[c], strict=True))) for c in cameras]


def _sightings_of(points: np.ndarray, views: Sequence[TrainingView]) -> Iterator[Sightings]:
    """What each view saw of world points (n, 3), in ascending order of the points."""

    def seen_in(view: TrainingView) -> Sightings:
        at = view.view.viewmat.double().cpu().numpy(), view.view.K.double().cpu().numpy()
        index, rows, columns, _ = visible(points, *at, (view.view.height, view.view.width))
        colors = view.pixels.cpu().numpy()[rows, columns]
        valid = ((colors > VALID_LEVELS[0]) & (colors < VALID_LEVELS[1])).all(axis=1)
        if view.ego_mask is not None:
            valid &= ~view.ego_mask.cpu().numpy()[rows, columns]
        position = view.view.camera_to_world[:3, 3].double().cpu().numpy()
        distances = np.linalg.norm(points[index[valid]] - position, axis=1)
        return Sightings(index[valid], distances, colors[valid])

    return prefetch(seen_in, views)


def gains_over_time(record: TrainingRecord, views: Sequence[TrainingView]) -> dict[str, GainCurve]:
    """How the exposure of each camera changes, by the seed points on surfaces; without cameras whose log gains stay
    within MIN_CURVE of their mean. `views` are the training images."""
    surfaces = _surfaces(record, CURVE_POINTS)
    seconds = np.array([record.seconds(i) for i in record.train_images])
    found = {}
    for camera in sorted(record.train_cameras):
        own = np.array([i for i, view in enumerate(views) if view.view.camera == camera])
        own = own[np.argsort(seconds[own], kind="stable")]
        gains = without_drift(gain_curve_of(list(_sightings_of(surfaces, [views[i] for i in own]))), seconds[own])
        if np.abs(gains).max(initial=0.0) < MIN_CURVE:
            continue
        found[camera] = GainCurve(seconds[own], gains)
        least, most = np.exp(gains[:, 1].min()), np.exp(gains[:, 1].max())
        log.info("%s: exposure changes: gains of green from %.2f to %.2f times their mean", camera, least, most)
    return found


def gain_curve_of(seen: Sequence[Sightings]) -> Float[np.ndarray, "k 3"]:
    """The log gains of k images of one camera, in order, by points that they share.

    The colour of a point changes with its distance, too, by haze above all. Of two images the log colours of a group of
    points therefore differ by that of the log gains, and by a constant of all images times the change of the log
    distance; least squares over the medians of all groups.
    """
    count, rows, columns, values, weights = len(seen), [], [], [], []
    for i, j in ((i, i + step) for step in NEXT_IMAGES for i in range(count - step)):
        _, at, also = np.intersect1d(seen[i].point, seen[j].point, assume_unique=True, return_indices=True)
        if len(at) < MIN_SHARED_POINTS:
            continue
        nearer = np.log(np.maximum(seen[j].distance[also], 1.0) / np.maximum(seen[i].distance[at], 1.0))
        change = np.log(seen[j].color[also].astype(np.float64)) - np.log(seen[i].color[at])
        for group in np.array_split(np.argsort(nearer), DISTANCE_GROUPS):
            rows.append((i, j))
            columns.append(np.median(nearer[group]))
            values.append(np.median(change[group], axis=0))
            weights.append(len(group))
    if not rows:
        return np.zeros((count, 3))
    equations = np.zeros((len(rows), count + 1))
    pairs, each = np.array(rows), np.arange(len(rows))
    equations[each, pairs[:, 0]], equations[each, pairs[:, 1]], equations[:, -1] = -1.0, 1.0, columns
    weighted = equations * np.array(weights)[:, None]
    normal = equations.T @ weighted
    normal += TIE * np.diag(normal).mean() * np.eye(count + 1)
    return np.linalg.solve(normal, weighted.T @ np.array(values))[:-1]


def without_drift(gains: Float[np.ndarray, "k 3"], seconds: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 3"]:
    """Log gains of mean 0 at ascending times whose slow changes are left out (DRIFT)."""
    change = np.diff(gains, axis=0)
    slow = DRIFT * np.diff(seconds)[:, None]
    kept = change * np.clip(np.abs(change) / np.maximum(slow, 1e-9) - 1.0, 0.0, 1.0)
    found = np.concatenate([np.zeros((1, 3)), np.cumsum(kept, axis=0)])
    return found - found.mean(axis=0)


def log_colors(seen: Sequence[Sightings], step: float) -> np.ndarray:
    """The logarithm of the mean colour (c, n, 3) that each of c cameras recorded of the n surfaces that several of them
    saw; NaN where a camera did not see one. A point counts as one surface in each interval of distance: intervals have
    the width `step` in the natural logarithm of the distance."""
    intervals = [np.floor(np.log(np.maximum(own.distance, 1.0)) / step).astype(np.int64) for own in seen]
    count = 1 + max((int(of_camera.max(initial=0)) for of_camera in intervals), default=0)
    means = [_means_by_key(own.point * count + at, own.color) for own, at in zip(seen, intervals, strict=True)]
    keys, cameras = np.unique(np.concatenate([own for own, _ in means]), return_counts=True)
    shared = keys[cameras > 1]
    found = np.full((len(seen), len(shared), 3), np.nan)
    for row, (own, colors) in zip(found, means, strict=True):
        also, at = _found_in(shared, own)
        row[at] = np.log(colors[also] / 255.0)
    return found


def _means_by_key(keys: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different keys, in order, and the mean (k, 3) of the values (m, 3) of each."""
    unique, at = np.unique(keys, return_inverse=True)
    sums = [np.bincount(at, weights=column, minlength=len(unique)) for column in values.T]
    return unique, np.stack(sums, axis=1) / np.bincount(at, minlength=len(unique))[:, None]


def _found_in(keys: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which (m,) bool of the `wanted` keys are among `keys`, which ascend, and where these are there."""
    at = np.searchsorted(keys, wanted)
    found = at < len(keys)
    found[found] = keys[at[found]] == wanted[found]
    return found, at[found]


def log_gains(observed: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The log gain (c, 3) of each camera, where `observed` log colours (c, n, 3) are those of the surface plus the log
    gain of the camera. `known` (c, 3) are those known before, which are kept; NaN for the others.

    Iterates over cameras: the median difference to the mean of the cameras known so far. NaN where too few points are
    shared.
    """
    gains, seen = known.copy(), np.isfinite(observed[..., 0])
    surfaces = [np.flatnonzero(of_camera) for of_camera in seen]
    colors = [own[of_camera] for own, of_camera in zip(observed, surfaces, strict=True)]
    sums, counts = np.zeros(observed.shape[1:]), np.zeros(observed.shape[1], dtype=np.int64)

    def count_in(camera: int, times: int) -> None:
        """Adds (1) or subtracts (-1) the colours of a camera with a known gain, without this gain."""
        if np.isfinite(gains[camera, 0]):
            sums[surfaces[camera]] += times * (colors[camera] - gains[camera])
            counts[surfaces[camera]] += times

    for camera in range(len(observed)):
        count_in(camera, 1)
    for _ in range(ROUNDS):
        for camera in np.flatnonzero(np.isnan(known[:, 0])).tolist():
            count_in(camera, -1)
            at = surfaces[camera]
            shared = counts[at] > 0
            if shared.sum() >= MIN_SHARED_POINTS:
                of_others = sums[at[shared]] / counts[at[shared], None]
                gains[camera] = np.median(colors[camera][shared] - of_others, axis=0)
            count_in(camera, 1)
    return gains
