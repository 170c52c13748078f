"""The stage `own_car`: which pixels of each camera show the recording car's own body.

The body moves with its cameras, so its pixels stay as they are while the rest of the image goes by. It is looked for in
training images alone, taken while the car drove, and taken to be seen only where all of this holds:

- it lies below the horizon, since the cameras look down on the car that carries them, and reaches the image's edge;
- LiDAR has met nothing there but the car itself: of an even road, which stays much the same as well, it has;
- its pixels vary little from image to image, in comparison with the image as a whole, once what light falls on them all
  is accounted for, and are neither white nor black, as what is blown out and a dark night stay, too;
- it ends where it ends: beside it pixels vary more, as they do not at the edge of what merely looks alike.

What does not pass is no own car. A body missed costs Gaussians before one camera; a body imagined costs figures.
"""

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from scipy import ndimage
from skimage.measure import approximate_polygon, find_contours

from drivesplat.lidar.coloring import in_image
from drivesplat.lidar.nearest_sweep import nearest_returns
from drivesplat.lidar.sweeps import training_sweeps
from drivesplat.scene.ego_mask import Outline, enclosed
from drivesplat.scene.images import continuous_intrinsics, pixel_rays, read_image
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.scene.splits import training_images
from drivesplat.settings.ego_mask import EgoMaskJob, EgoMaskSearch

log = logging.getLogger(__name__)

WIDTH = 320
"""Pixels across at which images are compared; lengths in pixels below are at this width."""
STEP = 1.0
"""Metres between the images compared: what is taken at a standstill shows all the world unmoved."""
MIN_IMAGES, MAX_IMAGES = 10, 60
MIN_PATH_LENGTH = 20.0
"""Metres from which on what is near has gone by."""
MIN_VARIATION = 16.0
"""Grey levels by which half of the image varies at least: by night nothing can be told."""
STILL = 0.3
"""The body varies at most by this fraction of what half of the image varies by."""
LEVELS = (6, 249)
"""Between these grey levels a pixel can be seen to vary."""
ENDS = 1.5
"""Beside the body pixels vary at least so many times as much as within it."""
RING = 4
"""Pixels on either side of the body's edge that are compared; the nearest one on either side is of both."""
REACH = 3
"""Pixels around LiDAR's returns that it has met something in: the beams lie farther apart than pixels."""
SHARES = (0.002, 0.25)
"""How much of an image a body fills, at least and at most."""
MARGIN = 2
"""Pixels by which a body that was found is enlarged: its edge is out of focus."""


def ego_mask_record(scene: Scene, job: EgoMaskJob) -> dict[str, Any]:
    """The record of `drivesplat.scene.ego_mask`, provenance aside. Raises DatasetError naming an image that is
    unreadable."""
    cameras = {}
    for camera in dict.fromkeys(frame.camera for frame in scene.frames):
        outlines, source, why = known(scene, camera, job)
        share = float(enclosed(outlines, (1600, 900)).mean())
        cameras[camera] = {"source": source, "outlines": outlines, "share": share, "why_null": why}
        log.info("%s: %s", camera, why or f"the own car fills {share:.1%} of the image, by {source}")
    return {"cameras": cameras}


def known(scene: Scene, camera: str, job: EgoMaskJob) -> tuple[tuple[Outline, ...], str | None, str | None]:
    """The body's outlines in the images of a camera; where they come from; and if from nowhere, why."""
    if camera in job.polygons:
        return (job.polygons[camera],), "polygons", None
    if job.search is None or camera not in job.search.cameras:
        return (), None, "not looked for, and no outline is given (masks.own_car, masks.own_car_polygons)"
    outlines, why = found_in(ComparedImages.of(scene, camera, job.search))
    return outlines, "images" if outlines else None, why


@dataclass(frozen=True)
class ComparedImages:
    """The images of one camera that are compared, and the sweeps that may tell of them; both in time order."""

    frames: tuple[Frame, ...]
    sweeps: tuple[Sweep, ...]
    interval: float
    own_car_radius: float

    @classmethod
    def of(cls, scene: Scene, camera: str, search: EgoMaskSearch) -> "Drive":
        """Of a scene's training images, and its training sweeps."""
        frames = (scene.frames[i] for i in training_images(scene, search.holdout))
        moving = on_the_move([frame for frame in frames if frame.camera == camera])
        sweeps = tuple(training_sweeps(scene, search.holdout))
        return cls(tuple(moving), sweeps, scene.key_frame_interval, search.own_car_radius)

    @property
    def way(self) -> float:
        """How far (metres) the car drove from the first image to the last."""
        return float(sum(_apart(a, b) for a, b in zip(self.frames, self.frames[1:], strict=False)))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels at which the images are compared."""
        first = self.frames[0]
        width = min(WIDTH, first.width)
        return width, max(1, round(first.height * width / first.width))

    @cached_property
    def images(self) -> np.ndarray:
        """(n, h, w, 3) uint8 of at most MAX_IMAGES, spread over the drive."""
        with ThreadPoolExecutor() as pool:
            return np.stack([*pool.map(lambda frame: read_image(frame.image_path, self.size), self.compared)])

    @property
    def compared(self) -> list[Frame]:
        """The images themselves, as the scene knows them."""
        count = min(MAX_IMAGES, len(self.frames))
        return [self.frames[i] for i in np.linspace(0, len(self.frames) - 1, count).round().astype(int)]

    def pixels(self, at_full_width: int) -> int:
        """A length in pixels, stated at WIDTH."""
        return max(1, round(at_full_width * self.size[0] / WIDTH))


def on_the_move(frames: Sequence[Frame]) -> list[Frame]:
    """Images, in time order, each at least STEP metres from the one before."""
    kept: list[Frame] = []
    for frame in sorted(frames, key=lambda frame: frame.timestamp):
        if not kept or _apart(kept[-1], frame) >= STEP:
            kept.append(frame)
    return kept


def _apart(a: Frame, b: Frame) -> float:
    return float(np.linalg.norm(a.camera_to_world[:3, 3] - b.camera_to_world[:3, 3]))


def found_in(drive: ComparedImages) -> tuple[tuple[Outline, ...], str | None]:
    """The body's outlines, as far as the images of a drive show it for certain; where they do not, why."""
    if len(drive.frames) < MIN_IMAGES or drive.way < MIN_PATH_LENGTH:
        return (), (
            f"the car hardly moves: {len(drive.frames)} images at least {STEP:g} m apart over {drive.way:.0f} m, where "
            f"{MIN_IMAGES} over {MIN_PATH_LENGTH:g} m are needed"
        )
    swept = lidar_images(drive)
    if len(swept) < MIN_IMAGES:
        return (), f"LiDAR tells of {len(swept)} images where {MIN_IMAGES} are needed: an even road stays alike, too"
    unmet = reaching_the_edge(below_horizon(drive) & (np.sum(swept, axis=0) < 2))
    if not unmet.any():
        return (), "LiDAR meets something all along the edge of the images"
    varies, usual = variation(drive.images)
    whole = float(np.median(varies))
    if whole < MIN_VARIATION:
        return (), f"half of the image varies by {whole:.0f} grey levels or less: too little to tell what stays"
    varies, _ = variation(evenly_lit(drive.images, unmet & _rim(unmet.shape, drive.pixels(RING))))
    still = (varies < STILL * whole) & (usual > LEVELS[0]) & (usual < LEVELS[1]) & below_horizon(drive)
    bodies = [
        piece for piece in pieces(still & enlarged(unmet, drive.pixels(REACH)), drive) if ends(piece, varies, drive)
    ]
    if not bodies:
        return (), "nothing stays as it is that could be the own car"
    mask = np.logical_or.reduce(bodies)
    if mask.mean() > SHARES[1]:
        return (), f"{mask.mean():.0%} of the image stays as it is: more than a body fills"
    return outlines_of(enlarged(mask, drive.pixels(MARGIN))), None


def evenly_lit(images: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Images (n, h, w, 3) float64 with each channel of each as bright as in the others, by the median over the pixels
    `where` (h, w) bool of what they are to their own medians over the images: what lights the body lights all of it."""
    pixels = images[:, where].astype(np.float64)
    brighter = np.median(pixels / np.maximum(np.median(pixels, axis=0), 1.0), axis=1)
    return images / np.maximum(brighter, 1e-3)[:, None, None, :]


def _rim(shape: tuple[int, int], width: int) -> np.ndarray:
    """The pixels (h, w) bool along the lower and the side edges of an image, where the body is, if there is one."""
    rim = np.ones(shape, dtype=bool)
    rim[:-width, width:-width] = False
    return rim


def variation(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far apart the tenth and the ninetieth percentile of every pixel's values are (h, w), in the channel in which
    that is most; and the pixel's median (h, w), averaged over the channels. `images` (n, h, w, 3), grey levels."""
    low, middle, high = np.percentile(images, (10, 50, 90), axis=0)
    return (high - low).max(axis=-1), middle.mean(axis=-1)


def below_horizon(drive: ComparedImages) -> np.ndarray:
    """The pixels (h, w) bool that look down, the car standing level."""
    frame = drive.frames[0]
    camera_to_ego = inverse(frame.ego_to_world) @ frame.camera_to_world
    return pixel_rays(drive.size, continuous_intrinsics(frame, drive.size), camera_to_ego)[..., 2] < 0.0


def lidar_images(drive: ComparedImages) -> list[np.ndarray]:
    """Per image that a sweep is near to, in time, the pixels (h, w) bool about which LiDAR met something. It sits above
    the cameras and farther from the car's edges, so that it sees nothing beyond the body that they do not see as well.
    """
    width, height = drive.size
    met = []
    for frame in drive.compared:
        points = nearest_returns(drive.sweeps, frame.timestamp, drive.interval, drive.own_car_radius)
        if points is not None:
            intrinsics = continuous_intrinsics(frame, drive.size)
            _, rows, columns, _ = in_image(points, inverse(frame.camera_to_world), intrinsics, (height, width))
            hit = np.zeros((height, width), dtype=bool)
            hit[rows, columns] = True
            met.append(enlarged(hit, drive.pixels(REACH)))
    return met


def reaching_the_edge(mask: np.ndarray) -> np.ndarray:
    """The pixels (h, w) bool of a mask that are connected to the image's lower or side edges."""
    labels, _ = ndimage.label(mask)
    at_edge = np.unique(np.concatenate([labels[-1], labels[:, 0], labels[:, -1]]))
    return np.isin(labels, at_edge[at_edge > 0])


def pieces(candidate: np.ndarray, drive: ComparedImages) -> list[np.ndarray]:
    """The connected pieces (h, w) bool of a mask that reach the image's edge and are large enough, without specks and
    gaps."""
    opened = cv2.morphologyEx(_framed(candidate), cv2.MORPH_OPEN, _disc(drive.pixels(1)))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _disc(drive.pixels(2)))[PAD:-PAD, PAD:-PAD]
    labels, count = ndimage.label(reaching_the_edge(closed))
    found = (ndimage.binary_fill_holes(labels == label) for label in range(1, count + 1))
    return [piece for piece in found if piece.mean() >= SHARES[0]]


PAD = 8
"""Pixels of the frame around a mask that continue it, so that its edge does not count as a border."""


def _framed(mask: np.ndarray) -> np.ndarray:
    return cv2.copyMakeBorder(mask.astype(np.uint8), PAD, PAD, PAD, PAD, cv2.BORDER_REPLICATE)


def ends(body: np.ndarray, varies: np.ndarray, drive: ComparedImages) -> bool:
    """Whether pixels (h, w) bool vary much less than those beside them, on either side of their edge."""
    near, far = drive.pixels(1), drive.pixels(RING)
    inside = body & ~_shrunk(body, far) & _shrunk(body, near)
    beside = enlarged(body, far) & ~enlarged(body, near)
    if not inside.any() or not beside.any():
        return False
    return float(np.median(varies[beside])) >= ENDS * float(np.median(varies[inside]))


def enlarged(mask: np.ndarray, by: int) -> np.ndarray:
    """A mask (h, w) bool with all pixels about it."""
    return cv2.dilate(mask.astype(np.uint8), _disc(by)).astype(bool)


def _shrunk(mask: np.ndarray, by: int) -> np.ndarray:
    return cv2.erode(_framed(mask), _disc(by))[PAD:-PAD, PAD:-PAD].astype(bool)


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def outlines_of(mask: np.ndarray) -> tuple[Outline, ...]:
    """The outer outlines of a mask (h, w) bool, half a pixel exact, in fractions of width and height. What reaches the
    image's edge is followed beyond it, so that no corner is cut off there."""
    height, width = mask.shape
    beyond = np.pad(_framed(ndimage.binary_fill_holes(mask)), 1).astype(float)
    outlines = []
    for contour in find_contours(beyond, 0.5):
        corners = approximate_polygon(contour, tolerance=0.5)[:-1, ::-1] - PAD - 0.5
        fractions = np.clip(corners / (width, height), 0.0, 1.0).round(4)
        outlines.append(tuple((float(x), float(y)) for x, y in fractions))
    return tuple(outlines)
