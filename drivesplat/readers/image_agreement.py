"""What images say against LiDAR returns, in sentences: silhouettes of returns, where depth jumps, lie on edges of
images. Where they do so better for a mirrored drive, at another time, or with another camera matrix, that is a warning.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.sampled_sweeps import SampledSweep
from drivesplat.scene.images import continuous_intrinsics, project, read_image
from drivesplat.scene.rigid import apply, interpolate, inverse, rigid
from drivesplat.scene.scene import Frame, Scene

WIDTH = 640
"""Maximum width in pixels at which images are compared."""
MAX_GAP_US = 100_000
"""Microseconds between an image and the sweep that it is compared with."""
DEPTHS, FARTHER, GAP = (1.0, 40.0), 1.25, 1.0
"""Depths in metres of silhouettes; the depth behind one is at least FARTHER times its own and GAP metres more."""
NEIGHBOURS, NEAR, FLAT = 9, 0.03, 2.0
"""Returns around one, the share of the width within which they lie, and the factor by which rows count more."""
MIN_POINTS, MIN_IMAGES = 30, 3
"""Silhouettes of an image, and images, that are needed."""
SHIFTS = tuple(float(s) for s in np.round(np.arange(-1.0, 1.025, 0.05), 2) if abs(s) > 0.09)
"""Seconds by which images are shifted."""
FACTORS = (0.5, 0.6, 2 / 3, 0.75, 0.8, 0.85, 0.9, 1.1, 1.2, 1.25, 4 / 3, 1.5, 5 / 3, 2.0)
"""Factors of the first two rows of camera matrices, as of images that were resized."""
TURNS = tuple(sign * turn for turn in (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0) for sign in (-1, 1))
"""Degrees by which cameras are turned about their y axes."""
MIN_SCORE, MARGIN, MIRROR_MARGIN, MAX_EXCESS, MIN_WINS = 1.3, 0.25, 0.12, 0.7, 0.75
"""A hypothesis is reported from this score on, if it exceeds the score as given by MARGIN (a mirrored drive, of which
there is one, by MIRROR_MARGIN), what is given exceeds 1, the score of random places, by at most MAX_EXCESS times as
much, and it is better in this share of the images."""
UNRELATED, MIN_UNRELATED = 1.12, 6
"""Below this score of so many images, returns and images have nothing to do with each other."""
MAX_VIEWS = 24
"""Images that are compared."""


class _View(NamedTuple):
    """An image and the silhouettes of a sweep in it: its upright `edges` (h, w), relative to those around, `points`
    (n, 3) in the world, those (m, 3) of the world `mirrored` at the ego vehicle, and the images of its camera in the
    order of time."""

    frame: Frame
    edges: np.ndarray
    points: np.ndarray
    mirrored: np.ndarray
    of_camera: Sequence[Frame]

    def score(self, pose: np.ndarray, factor: float = 1.0, mirrored: bool = False) -> float:
        """The mean edge at the silhouettes by the mean of the image, for a camera pose (4, 4), K times `factor`, and
        the world as it is or mirrored; NaN where too few are in the image."""
        height, width = self.edges.shape
        k = np.diag([factor, factor, 1.0]) @ continuous_intrinsics(self.frame, (width, height))
        pixels, depth = project(self.mirrored if mirrored else self.points, inverse(pose), k)
        inside = (depth > DEPTHS[0]) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
        if inside.sum() < MIN_POINTS or not self.edges.any():
            return float("nan")
        columns, rows = pixels[inside].astype(int).T
        return float(self.edges[rows, columns].mean() / self.edges.mean())

    def later(self, seconds: float) -> np.ndarray:
        """The pose of the camera (4, 4) some seconds after the image, along its path."""
        times = np.array([frame.timestamp for frame in self.of_camera])
        time = self.frame.timestamp + seconds * 1e6
        after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
        start, end = self.of_camera[after - 1], self.of_camera[after]
        share = float((time - start.timestamp) / (end.timestamp - start.timestamp))
        return interpolate(start.camera_to_world, end.camera_to_world, share)


def image_warnings(scene: Scene, sweeps: list[SampledSweep]) -> list[str]:
    """A sentence about a drive that is mirrored, or about cameras, all or one by one, whose clock, matrix or mount is
    another one than stated. Images of distorted cameras are compared once they are resampled."""
    rectified = [camera.name for camera in scene.cameras if camera.distortion_model == "none"]
    views = {name: list(_views(scene, sweeps, name)) for name in rectified}
    every = [view for of_camera in views.values() for view in of_camera]
    given, mirrored = (
        [view.score(view.frame.camera_to_world, mirrored=flag) for view in every] for flag in (False, True)
    )
    if _is_better(given, mirrored, MIRROR_MARGIN):
        return [
            f"LiDAR returns fit the edges of images better if the drive is mirrored (score {_mean(mirrored):.2f} "
            f"instead of {_mean(given):.2f}): world, ego and LiDAR frames must be right-handed (x forward, y left, z "
            "up), and y must not be negated"
        ]
    if found := list(_camera_warnings("all cameras" if len(views) > 1 else "".join(views), every)):
        return found
    return [sentence for name, own in views.items() for sentence in _camera_warnings(f"camera {name}", own)]


def _camera_warnings(name: str, views: list[_View]) -> Iterator[str]:
    """The hypothesis about the images `views` that fits best, if one fits clearly better than what is given."""
    given = [view.score(view.frame.camera_to_world) for view in views]
    tried: dict[str, list[float]] = {}
    for shift in SHIFTS if all(len(view.of_camera) > 1 for view in views) else ():
        way, fault = ("later", "early") if shift > 0 else ("earlier", "late")
        said = f"with poses {abs(shift):.2f} s {way}: timestamps of images seem to be too {fault}"
        tried[said] = [view.score(view.later(shift)) for view in views]
    for factor in FACTORS:
        said = f"if K is multiplied by {factor:.2f}: K must be that of images of the stated size"
        tried[said] = [view.score(view.frame.camera_to_world, factor) for view in views]
    for turn in TURNS:
        side = "right" if turn > 0 else "left"
        said = f"if the camera is turned by {abs(turn):.1f} degrees to the {side}: check sensor_to_ego"
        turned = rigid(Rotation.from_euler("y", turn, degrees=True).as_matrix(), np.zeros(3))
        tried[said] = [view.score(view.frame.camera_to_world @ turned) for view in views]
    found = {said: _mean(scores) for said, scores in tried.items() if _is_better(given, scores, MARGIN)}
    if found:
        best = max(found, key=lambda hypothesis: found[hypothesis])
        yield (
            f"{name}: LiDAR returns fit the edges of images better (score {found[best]:.2f} instead of "
            f"{_mean(given):.2f}) {best}"
        )
    elif np.isfinite(given).sum() >= MIN_UNRELATED and _mean(given) < UNRELATED:
        yield (
            f"{name}: LiDAR returns do not lie on the edges of images (score {_mean(given):.2f}; 1 is that of random "
            "places): check K, distortion, sensor_to_ego and the times of images and sweeps"
        )


def _is_better(given: Sequence[float], other: Sequence[float], margin: float) -> bool:
    """Whether the scores of a hypothesis exceed those as given clearly, over enough images."""
    known = np.isfinite(other)
    one, two = np.nan_to_num(given, nan=1.0)[known], np.array(other)[known]
    if len(two) < MIN_IMAGES:
        return False
    least = max(MIN_SCORE, one.mean() + margin, 1.0 + (one.mean() - 1.0) / MAX_EXCESS)
    return bool(two.mean() >= least and (two > one).mean() >= MIN_WINS)


def _mean(scores: Sequence[float]) -> float:
    known = [score for score in scores if np.isfinite(score)]
    return float(np.mean(known)) if known else 1.0


def _views(scene: Scene, sweeps: list[SampledSweep], camera: str) -> Iterator[_View]:
    """The images of a camera nearest to the sweeps, with their silhouettes."""
    of_camera = sorted((frame for frame in scene.frames if frame.camera == camera), key=lambda frame: frame.timestamp)
    chosen = np.linspace(0, len(sweeps) - 1, max(MIN_IMAGES, MAX_VIEWS // len(scene.cameras))).round().astype(int)
    for sampled in [sweeps[i] for i in np.unique(chosen)] if of_camera and sweeps else ():
        frame = min(of_camera, key=lambda frame: abs(frame.timestamp - sampled.sweep.timestamp))
        if abs(frame.timestamp - sampled.sweep.timestamp) > MAX_GAP_US:
            continue
        width = min(WIDTH, frame.width)
        size = width, max(1, round(width * frame.height / frame.width))
        mirror = frame.ego_to_world @ np.diag([1.0, -1.0, 1.0, 1.0]) @ inverse(frame.ego_to_world)
        points = _silhouettes(sampled.points, frame, size)
        mirrored = _silhouettes(apply(mirror, sampled.points), frame, size)
        with suppress(DatasetError):  # the check of images names it
            grey = cv2.cvtColor(read_image(frame.image_path, size), cv2.COLOR_RGB2GRAY).astype(np.float32)
            gradient = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0))
            edges = np.minimum(cv2.GaussianBlur(gradient, (0, 0), 1.2) / (cv2.blur(gradient, (41, 41)) + 4.0), 4.0)
            yield _View(frame, edges, points, mirrored, of_camera)


def _silhouettes(points: np.ndarray, frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """Of world points (n, 3), those in an image beside which others are much farther, and none much nearer."""
    pixels, depth = project(points, inverse(frame.camera_to_world), continuous_intrinsics(frame, size))
    inside = (depth > DEPTHS[0]) & (depth < DEPTHS[1]) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)
    points, pixels, depth = points[inside], pixels[inside], depth[inside]
    if len(points) < NEIGHBOURS:
        return points[:0]
    places = pixels * [1.0, FLAT]
    distances, rows = cKDTree(places).query(places, k=NEIGHBOURS, distance_upper_bound=NEAR * size[0])
    found = np.isfinite(distances)
    around, own = depth[np.where(found, rows, 0)], depth[:, None]
    farther = found & (around > FARTHER * own + GAP)
    nearer = found & (around < own / FARTHER - GAP / 2)
    return points[farther.any(axis=1) & ~nearer.any(axis=1)]
