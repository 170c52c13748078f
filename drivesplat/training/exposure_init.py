"""Initial exposures, estimated before the training: of cameras from surfaces that several of them recorded, and over
time from surfaces that successive images show.

Training alone hardly corrects them: Gaussians seen by one camera, or for a few seconds, soon take on its colours, and
then confirm its exposure.
"""

import logging
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from drivesplat.io.prefetch import prefetch
from drivesplat.lidar.coloring import visible
from drivesplat.model.exposure import DARKEST, ExposureStart
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
STEPS = (1, 2)
"""Images of a camera whose colours are compared are so many apart."""
MIN_SIGMA = 0.005
"""Least expected error of the log gain between two images."""
WALK = 0.1
"""Expected change of log gains within a second, a random walk."""
MAX_RATIO = 0.3
"""Log ratios of colours farther from their median do not tell how colours change with distance."""
MAX_RESPONSE = 1.0
"""The response of an ideal exposure control."""


class Sightings(NamedTuple):
    """m sightings of points by a camera: `point` (m,), the index of each, `distance` (m,) in metres, and `color` (m, 3)
    in levels of 0 to 255."""

    point: np.ndarray
    distance: np.ndarray
    color: np.ndarray


def exposure_start(
    record: TrainingRecord,
    views: Sequence[TrainingView],
    cameras: Sequence[str],
    reference: str,
    interval: float | None,
) -> ExposureStart | None:
    """What exposures start from, with nodes about every `interval` seconds (None: constant exposures); None where there
    is nothing to learn, with one camera and without nodes. `cameras`: those with training images beside the reference
    camera; `views`: the training images."""
    gains = initial_gains(record, views, cameras, reference) if cameras else {}
    first = {camera: torch.from_numpy(values).float() for camera, values in gains.items()}
    nodes = exposure_nodes([view.view.time for view in views], interval)
    if not len(nodes):
        return ExposureStart(first) if first else None
    found = {}
    for camera in (reference, *cameras):
        own = sorted((view for view in views if view.view.camera == camera), key=lambda view: view.view.time)
        found[camera] = torch.from_numpy(gains_over_time(_surfaces(record), own, nodes)).float()
    brightness = [mean_brightness(view) for view in views if view.view.camera == reference]
    mean = float(np.exp(np.mean(np.log(brightness)))) if brightness else 0.5
    return ExposureStart(first, torch.from_numpy(nodes).float(), found, mean)


def exposure_nodes(seconds: Sequence[float], interval: float | None) -> Float[np.ndarray, " k"]:
    """Times at even intervals of about `interval` seconds, from the first to the last of the training images at
    `seconds`; none where exposures are constant (None) or the drive is shorter than half an interval."""
    if interval is None or not len(seconds):
        return np.zeros(0)
    count = round((max(seconds) - min(seconds)) / interval) + 1
    return np.linspace(min(seconds), max(seconds), count) if count > 1 else np.zeros(0)


def mean_brightness(view: TrainingView) -> float:
    """The mean of an image, 1 = full scale."""
    return max(DARKEST, float(view.target().mean()))


def gains_over_time(
    surfaces: Float[np.ndarray, "n 3"], views: Sequence[TrainingView], nodes: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "r 3"]:
    """The response of a camera and its log gains at the nodes, (1 + k, 3), as `ExposureStart.found` has them, from its
    `views` in order of time and from points on surfaces.

    The log ratios of the colours in which two images show the same points have the difference of their log gains as
    median, without the share that grows with how much nearer a point is in one of them. All differences together give
    the log gain of each image, with a random walk as prior, up to a constant: their mean is 0. How they fall with the
    brightness of the scene, that of the image without its gain, is the response; the nodes have the rest.
    """
    if len(views) < 2:
        return np.zeros((1 + len(nodes), 3))
    seconds = np.array([view.view.time for view in views])
    gains = _log_gains_of_images(list(prefetch(lambda view: _seen_in(surfaces, view), views)), seconds)
    scene = np.log([mean_brightness(view) for view in views]) - gains.mean(axis=1)
    scene -= scene.mean()
    response = np.clip(-(scene @ gains) / max(scene @ scene, 1e-6), 0.0, MAX_RESPONSE)
    weights = np.clip(1.0 - np.abs(seconds[:, None] - nodes) / (nodes[1] - nodes[0]), 0.0, None)
    walk = np.diff(np.eye(len(nodes)), axis=0) * MIN_SIGMA / WALK / np.sqrt(nodes[1] - nodes[0])
    rest = np.concatenate([gains + scene[:, None] * response, np.zeros((len(walk), 3))])
    return np.vstack([response, np.linalg.lstsq(np.vstack([weights, walk]), rest, rcond=None)[0]])


def _log_gains_of_images(seen: Sequence[Sightings], seconds: np.ndarray) -> Float[np.ndarray, "v 3"]:
    """The log gains of the images of one camera, with mean 0, from what each saw at `seconds` (v,)."""
    pairs = []
    for step in STEPS:
        for i, j in zip(range(len(seen) - step), range(step, len(seen)), strict=True):
            _, a, b = np.intersect1d(seen[i].point, seen[j].point, assume_unique=True, return_indices=True)
            if len(a) >= MIN_SHARED_POINTS:
                ratios = np.log(seen[j].color[b] / seen[i].color[a])
                pairs.append((i, j, ratios, np.log(seen[i].distance[a] / seen[j].distance[b])))
    by_approach = _change_by_approach([(ratios, nearer) for _, _, ratios, nearer in pairs])
    count = len(seen)
    rows = [np.full((1, count), 1.0 / count)]
    rows.append(np.diff(np.eye(count), axis=0) / (WALK * np.sqrt(np.maximum(np.diff(seconds), 1e-3)))[:, None])
    values = [np.zeros((count, 3))]
    for i, j, ratios, nearer in pairs:
        ratios = ratios - nearer[:, None] * by_approach
        middle = np.median(ratios, axis=0)
        sigma = max(MIN_SIGMA, 1.5 * float(np.median(np.abs(ratios - middle))) / np.sqrt(len(ratios)))
        row = np.zeros((1, count))
        row[0, [i, j]] = -1.0 / sigma, 1.0 / sigma
        rows.append(row)
        values.append(middle[None] / sigma)
    gains = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    return gains - gains.mean(axis=0)


def _change_by_approach(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Float[np.ndarray, "3"]:
    """How log colours change with the log of how much nearer a point is, within pairs of images: of haze, and of
    texture that a pixel resolves or averages."""
    products, squares = np.zeros(3), 1e-6
    for ratios, nearer in pairs:
        off, by = ratios - np.median(ratios, axis=0), nearer - np.median(nearer)
        typical = np.abs(off).max(axis=1) < MAX_RATIO
        products += by[typical] @ off[typical]
        squares += by[typical] @ by[typical]
    return products / squares


def _surfaces(record: TrainingRecord) -> Float[np.ndarray, "n 3"]:
    """Seed points on surfaces, at most MAX_POINTS."""
    surfaces = record.points[: len(record.points) - record.seed.far]
    return surfaces[:: max(1, math.ceil(len(surfaces) / MAX_POINTS))].astype(np.float64)


def initial_gains(
    record: TrainingRecord, views: Sequence[TrainingView], cameras: Sequence[str], reference: str
) -> dict[str, np.ndarray]:
    """The gains (3,) of the colour channels of each of `cameras` relative to the reference camera, by the seed points
    on surfaces; 1 for a camera that shares too few points. `views` are the training images.

    Colours are compared between images that show a point from about the same distance, since haze brightens what is far
    away: a camera that looks ahead sees a facade from farther away than one that looks aside, whose gain would come out
    too small. Cameras that share too few such points are compared at any distance.
    """
    seen = sightings(_surfaces(record), views, [reference, *cameras])
    gains = np.full((1 + len(cameras), 3), np.nan)
    gains[0] = 0.0
    for step in (DISTANCE_STEP, math.inf):
        if np.isnan(gains).any():
            gains = log_gains(log_colors(seen, step), gains)
    found = np.exp(np.nan_to_num(gains))
    for camera, gain in zip(cameras, found[1:], strict=True):
        log.info("%s: gains of %.2f, %.2f, %.2f over %s", camera, *gain, reference)
    return dict(zip(cameras, found[1:], strict=True))


def sightings(points: np.ndarray, views: Sequence[TrainingView], cameras: Sequence[str]) -> list[Sightings]:
    """What each of `cameras` saw of world points (n, 3). Pixels of the ego vehicle and those outside VALID_LEVELS are
    left out."""
    found: dict[str | None, list[Sightings]] = {camera: [] for camera in cameras}
    chosen = [view for view in views if view.view.camera in found]
    for view, own in zip(chosen, prefetch(lambda view: _seen_in(points, view), chosen), strict=True):
        found[view.view.camera].append(own)
    nothing = Sightings(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)))
    return [Sightings(*(np.concatenate(values) for values in zip(nothing, *found[c], strict=True))) for c in cameras]


def _seen_in(points: np.ndarray, view: TrainingView) -> Sightings:
    """What an image shows of world points (n, 3), as `sightings`."""
    at = view.view.viewmat.double().cpu().numpy(), view.view.K.double().cpu().numpy()
    index, rows, columns, _ = visible(points, *at, (view.view.height, view.view.width))
    colors = view.pixels.cpu().numpy()[rows, columns]
    valid = ((colors > VALID_LEVELS[0]) & (colors < VALID_LEVELS[1])).all(axis=1)
    if view.ego_mask is not None:
        valid &= ~view.ego_mask.cpu().numpy()[rows, columns]
    position = view.view.camera_to_world[:3, 3].double().cpu().numpy()
    distances = np.linalg.norm(points[index[valid]] - position, axis=1)
    return Sightings(index[valid], distances, colors[valid])


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
