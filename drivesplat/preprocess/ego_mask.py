"""The stage `own_car`: the pixels of each camera that show the body of the ego vehicle.

The body moves with the cameras, so its pixels stay constant while the rest of the image changes. The search uses only
training images taken while the vehicle was moving. A region counts as the body if all of these hold:

- It lies below the horizon, since the cameras look down on the vehicle, and touches the image's lower or side edges.
- It has no LiDAR returns except those of the vehicle itself. An even road is constant too, but has returns.
- Its pixels vary little between images, relative to the whole image and after correction for the lighting, and are
  neither white nor black: overexposed areas and a dark night are constant too.
- Pixels just outside its border vary more. At the border of a uniform area they do not.

Anything else is not masked. A missed body costs Gaussians in front of one camera; a false one distorts the metrics.
"""

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from scipy import ndimage

from drivesplat.lidar.coloring import in_image
from drivesplat.lidar.sweeps import nearest_returns, sweeps_of
from drivesplat.scene.ego_mask import Outline, enclosed
from drivesplat.scene.images import continuous_intrinsics, read_image, upward_rays
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.scene.splits import training_images
from drivesplat.settings.masks import EgoMaskJob, EgoMaskSearch

log = logging.getLogger(__name__)

WIDTH = 320
"""Width in pixels at which images are compared; the lengths in pixels below refer to it."""
MIN_STEP = 1.0
"""Minimum distance in metres between compared images: at a standstill the whole image is constant."""
MIN_IMAGES, MAX_IMAGES = 10, 60
MIN_PATH_LENGTH = 20.0
"""Minimum path length in metres, after which everything near the vehicle has left the image."""
MIN_VARIATION = 16.0
"""Minimum median variation of an image's pixels in grey levels; night images vary less."""
MAX_BODY_VARIATION = 0.3
"""Maximum variation of the body's pixels, as a fraction of the image's median variation."""
LEVELS = (6, 249)
"""Range of grey levels in which a pixel's variation is visible."""
MIN_CONTRAST = 1.5
"""Minimum ratio of the variation just outside the body to that just inside."""
RING = 4
"""Pixels compared on either side of the body's border; the nearest one on either side is left out."""
REACH = 3
"""Pixels around a LiDAR return that count as hit: the beams are farther apart than pixels."""
SHARES = (0.002, 0.25)
"""Minimum and maximum share of the image that a body fills."""
MARGIN = 2
"""Pixels by which a detected body is dilated: its border is out of focus."""


def ego_mask_record(scene: Scene, job: EgoMaskJob) -> dict[str, Any]:
    """The record described in `drivesplat.scene.ego_mask`, without provenance. Raises DatasetError naming an unreadable
    image."""
    cameras = {}
    for camera in dict.fromkeys(frame.camera for frame in scene.frames):
        outlines, source, why = camera_outlines(scene, camera, job)
        share = float(enclosed(outlines, (1600, 900)).mean())
        cameras[camera] = {"source": source, "outlines": outlines, "share": share, "why_null": why}
        log.info("%s: %s", camera, why or f"the ego vehicle covers {share:.1%} of the image (source: {source})")
    return {"cameras": cameras}


def camera_outlines(scene: Scene, camera: str, job: EgoMaskJob) -> tuple[tuple[Outline, ...], str | None, str | None]:
    """The body's outlines in a camera's images; their source; and the reason where there is none."""
    if camera in job.polygons:
        return (job.polygons[camera],), "polygons", None
    if job.search is None or camera not in job.search.cameras:
        return (), None, "not searched, and no outline is given (masks.own_car, masks.own_car_polygons)"
    outlines, why = find_outlines(ComparedImages.of(scene, camera, job.search))
    return outlines, "images" if outlines else None, why


@dataclass(frozen=True)
class ComparedImages:
    """One camera's images for the search, chosen from `recorded` training images, and the scene's training sweeps, both
    in time order; `interval` is the maximum time in microseconds from an image to its sweep, `own_car_radius` that of
    the ego vehicle in metres."""

    recorded: int
    frames: tuple[Frame, ...]
    sweeps: tuple[Sweep, ...]
    interval: float
    own_car_radius: float

    @classmethod
    def of(cls, scene: Scene, camera: str, search: EgoMaskSearch) -> "ComparedImages":
        """From a scene's training images, each at least MIN_STEP metres from the previous one, and training sweeps."""
        frames = [scene.frames[i] for i in training_images(scene, search.holdout) if scene.frames[i].camera == camera]
        spaced: list[Frame] = []
        for frame in sorted(frames, key=lambda frame: frame.timestamp):
            if not spaced or _distance(spaced[-1], frame) >= MIN_STEP:
                spaced.append(frame)
        sweeps = tuple(sweeps_of(scene, search.holdout))
        return cls(len(frames), tuple(spaced), sweeps, scene.key_frame_interval, search.own_car_radius)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels at which the images are compared."""
        first = self.frames[0]
        width = min(WIDTH, first.width)
        return width, max(1, round(first.height * width / first.width))

    @cached_property
    def images(self) -> np.ndarray:
        """The compared images (n, h, w, 3) uint8 RGB."""
        with ThreadPoolExecutor() as pool:
            return np.stack([*pool.map(lambda frame: read_image(frame.image_path, self.size), self.compared)])

    @property
    def compared(self) -> list[Frame]:
        """At most MAX_IMAGES frames, spread evenly over the drive."""
        count = min(MAX_IMAGES, len(self.frames))
        return [self.frames[i] for i in np.linspace(0, len(self.frames) - 1, count).round().astype(int)]

    def pixels(self, at_full_width: int) -> int:
        """A length in pixels at WIDTH, converted to the compared size; at least 1."""
        return max(1, round(at_full_width * self.size[0] / WIDTH))


def _distance(a: Frame, b: Frame) -> float:
    return float(np.linalg.norm(a.camera_to_world[:3, 3] - b.camera_to_world[:3, 3]))


def find_outlines(drive: ComparedImages) -> tuple[tuple[Outline, ...], str | None]:
    """The body's outlines, where the images show it with certainty; otherwise none, and the reason."""
    if drive.recorded < MIN_IMAGES:
        return (), f"too few images: {drive.recorded} for training; {MIN_IMAGES} are needed"
    path_length = sum(_distance(a, b) for a, b in pairwise(drive.frames))
    if len(drive.frames) < MIN_IMAGES or path_length < MIN_PATH_LENGTH:
        return (), (
            f"too short a path: {len(drive.frames)} images at least {MIN_STEP:g} m apart over "
            f"{path_length:.0f} m; {MIN_IMAGES} over {MIN_PATH_LENGTH:g} m are needed"
        )
    hits = lidar_images(drive)
    if len(hits) < MIN_IMAGES:
        return (), f"{len(hits)} images have LiDAR; {MIN_IMAGES} are needed to tell the body from an even road"
    first = drive.frames[0]
    camera_to_ego = inverse(first.ego_to_world) @ first.camera_to_world
    below_horizon = upward_rays(drive.size, continuous_intrinsics(first, drive.size), camera_to_ego) < 0.0
    unreached = touching_edge(below_horizon & (np.sum(hits, axis=0) < 2))
    if not unreached.any():
        return (), "LiDAR has returns all along the edge of the images"
    varies, median = variation(drive.images)
    whole = float(np.median(varies))
    if whole < MIN_VARIATION:
        return (), f"half of the pixels vary by {whole:.0f} grey levels or less: too little to detect constant ones"
    # A body, if there is one, is lit as a whole: an image's brightness is the median ratio of the pixels near the edges
    # to their medians over all images.
    rim, width = unreached.copy(), drive.pixels(RING)
    rim[:-width, width:-width] = False
    pixels = drive.images[:, rim].astype(np.float64)
    brightness = np.median(pixels / np.maximum(np.median(pixels, axis=0), 1.0), axis=1)
    varies, _ = variation(drive.images / np.maximum(brightness, 1e-3)[:, None, None, :])
    constant = (varies < MAX_BODY_VARIATION * whole) & (median > LEVELS[0]) & (median < LEVELS[1]) & below_horizon
    candidates = components(constant & dilated(unreached, drive.pixels(REACH)), drive)
    bodies = [piece for piece in candidates if contrasts(piece, varies, drive)]
    if not bodies:
        return (), "no constant region can be the ego vehicle"
    mask = np.logical_or.reduce(bodies)
    if mask.mean() > SHARES[1]:
        return (), f"{mask.mean():.0%} of the image is constant: more than a body fills"
    return outlines_of(dilated(mask, drive.pixels(MARGIN))), None


def variation(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The variation of every pixel of `images` (n, h, w, 3) in grey levels: the range (h, w) from its 10th to its 90th
    percentile, in the channel where it is largest; and its median (h, w), averaged over the channels."""
    low, middle, high = np.percentile(images, (10, 50, 90), axis=0)
    return (high - low).max(axis=-1), middle.mean(axis=-1)


def lidar_images(drive: ComparedImages) -> list[np.ndarray]:
    """The pixels (h, w) bool near a LiDAR return, for each image with a sweep close in time. LiDAR is mounted above the
    cameras and farther from the vehicle's edges, so the body hides from LiDAR all that it hides from the cameras."""
    width, height = drive.size
    images = []
    for frame in drive.compared:
        points = nearest_returns(drive.sweeps, frame.timestamp, drive.interval, drive.own_car_radius)
        if points is not None:
            intrinsics = continuous_intrinsics(frame, drive.size)
            _, rows, columns, _ = in_image(points, inverse(frame.camera_to_world), intrinsics, (height, width))
            hit = np.zeros((height, width), dtype=bool)
            hit[rows, columns] = True
            images.append(dilated(hit, drive.pixels(REACH)))
    return images


def touching_edge(mask: np.ndarray) -> np.ndarray:
    """The pixels (h, w) bool of a mask that are connected to the image's lower or side edges."""
    labels, _ = ndimage.label(mask)
    at_edge = np.unique(np.concatenate([labels[-1], labels[:, 0], labels[:, -1]]))
    return np.isin(labels, at_edge[at_edge > 0])


def components(candidate: np.ndarray, drive: ComparedImages) -> list[np.ndarray]:
    """The connected components (h, w) bool of a mask that touch the image's edge and have the minimum area, with specks
    removed and gaps closed."""
    opened = cv2.morphologyEx(_padded(candidate), cv2.MORPH_OPEN, _disc(drive.pixels(1)))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _disc(drive.pixels(2)))[PAD:-PAD, PAD:-PAD]
    labels, count = ndimage.label(touching_edge(closed))
    found = (ndimage.binary_fill_holes(labels == label) for label in range(1, count + 1))
    return [piece for piece in found if piece.mean() >= SHARES[0]]


PAD = 8
"""Pixels by which a mask is padded with its edge values, so that the image's edge is not a border of the mask."""


def _padded(mask: np.ndarray) -> np.ndarray:
    return cv2.copyMakeBorder(mask.astype(np.uint8), PAD, PAD, PAD, PAD, cv2.BORDER_REPLICATE)


def contrasts(body: np.ndarray, varies: np.ndarray, drive: ComparedImages) -> bool:
    """Whether pixels of the body (h, w) bool vary much less than those outside it, in a ring around its border."""
    near, far = drive.pixels(1), drive.pixels(RING)
    eroded = [cv2.erode(_padded(body), _disc(by))[PAD:-PAD, PAD:-PAD].astype(bool) for by in (far, near)]
    inside = body & ~eroded[0] & eroded[1]
    beside = dilated(body, far) & ~dilated(body, near)
    if not inside.any() or not beside.any():
        return False
    return float(np.median(varies[beside])) >= MIN_CONTRAST * float(np.median(varies[inside]))


def dilated(mask: np.ndarray, by: int) -> np.ndarray:
    """A mask (h, w) bool dilated by a disc with radius `by` pixels."""
    return cv2.dilate(mask.astype(np.uint8), _disc(by)).astype(bool)


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def outlines_of(mask: np.ndarray) -> tuple[Outline, ...]:
    """The outer outlines of a mask (h, w) bool, exact to half a pixel, in fractions of width and height. Regions at the
    image's edge are traced beyond it, so that no corner is cut off."""
    from skimage.measure import approximate_polygon, find_contours  # 0.4 s, for drives that show the ego vehicle

    height, width = mask.shape
    padded = np.pad(_padded(ndimage.binary_fill_holes(mask)), 1).astype(float)
    outlines = []
    for contour in find_contours(padded, 0.5):
        corners = approximate_polygon(contour, tolerance=0.5)[:-1, ::-1] - PAD - 0.5
        fractions = np.clip(corners / (width, height), 0.0, 1.0).round(4)
        outlines.append(tuple((float(x), float(y)) for x, y in fractions))
    return tuple(outlines)
