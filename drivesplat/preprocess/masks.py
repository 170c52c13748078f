"""The stage `masks`: static, dynamic and sky regions of every image, as PNG files; and the stage `regions`, the masks
of a scene for other tracks than the annotated ones.

- masks/masks.json: the masks' sources, and the cameras that see the ego vehicle
- masks/regions/{camera}/{timestamp}.png: labels of `drivesplat.scene.regions.LABELS`
- masks/sky/{camera}/{timestamp}.png: 255 in the sky
- masks/semantic/{camera}/{timestamp}.png: the user's semantic classes, if given
"""

import dataclasses
import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from drivesplat.errors import ConfigError, DatasetError
from drivesplat.lidar.sweeps import nearest_returns, sweeps_of
from drivesplat.readers.files import link_or_copy
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.images import (
    continuous_intrinsics,
    project,
    read_image,
    read_mask,
    target_size,
    upward_rays,
    write_png,
)
from drivesplat.scene.masks import UNLABELLED, MasksRecord, mask_name, read_labels, read_masks_record
from drivesplat.scene.regions import LABELS, fill, hulls_in, label_image, visibility_source
from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.scene.splits import Group, frame_groups
from drivesplat.settings.masks import MaskJob, RegionJob

log = logging.getLogger(__name__)

MIN_ELEVATION = np.sin(np.radians(1.0))
"""Sine of the minimum elevation of sky, one degree above the horizon."""
WHITE = 3 * 255
"""Sum of the channels of a white pixel."""
MIN_BRIGHTNESS = 0.35
"""Minimum brightness of sky with a blue tint, in [0, 1]."""
BRIGHT = 0.7
"""Minimum brightness of sky without a blue tint (overcast)."""
SMOOTH = 0.045
"""Maximum brightness gradient of sky, per pixel at 640 pixels' width."""
LIDAR_REACH = 12
"""Distance from a LiDAR return within which no pixel is sky, in pixels at 640 pixels' width."""
MIN_SKY = 0.005
"""Minimum share of sky over all images. Below it the heuristic, which looks for bright pixels, has found no sky."""
NO_SKY = (
    "scene %s: no sky was found, as is usual at night or in a tunnel: sky losses are disabled; "
    "set masks.sky_folder to use your own masks"
)
SHARED = ("sky", "semantic")
"""The kinds of masks that depend on no track."""


def make_masks(
    scene: Scene, job: MaskJob, folder: Path, ego_mask: EgoMask = NO_EGO_MASK, threads: int | None = None
) -> MasksRecord:
    """Writes the masks of every image below `folder`, in `threads` threads (None: more than processors); returns the
    record for masks.json. The ego vehicle's body is a region of its own, neither sky nor of any class. The sky of
    training images depends on training sweeps only.

    Raises DatasetError naming the file where a user's mask is missing, unreadable, in colours or of another aspect
    ratio than its image, ConfigError where a user's folder is the output.
    """
    for setting in ("regions_folder", "sky_folder", "semantic_folder"):
        given = getattr(job.masks, setting)
        if given and Path(given).expanduser().resolve().is_relative_to(folder.resolve()):
            raise ConfigError(
                f"masks.{setting}: {given} is where the rule 'masks' writes; copy it, and name the copy (docs/masks.md)"
            )
    groups, training = frame_groups(scene, job.holdout), sweeps_of(scene, job.holdout)

    def one(frame: Frame, group: Group) -> tuple[float, int, bool]:
        size = target_size(frame, job.images)
        if job.masks.regions_folder:
            labels = _users_mask(job.masks.regions_folder, frame, size).copy()
            if labels.max() > max(LABELS.values()):
                raise DatasetError(
                    f"masks.regions_folder: {users_file(job.masks.regions_folder, frame)} holds label {labels.max()}; "
                    f"the highest label is {max(LABELS.values())}"
                )
        else:
            labels = label_image(scene, frame, size)
        labels[ego_mask.pixels(frame.camera, size)] = LABELS["own_car"]
        body = labels == LABELS["own_car"]
        sweeps = training if group == "train" else scene.sweeps
        sky = _sky(sweeps, scene, frame, job, size) & ~body
        write_png(folder / mask_name("sky", frame.camera, frame.timestamp), sky.astype(np.uint8) * 255)
        write_png(folder / mask_name("regions", frame.camera, frame.timestamp), labels)
        return float(sky.mean()), _semantic(scene, frame, job, body, folder), bool(body.any())

    with ThreadPoolExecutor(threads) as pool:
        sky_shares, classes, bodies = zip(*pool.map(one, scene.frames, groups), strict=True)
    seeing = {frame.camera for frame, body in zip(scene.frames, bodies, strict=True) if body}
    labelled = sum(frame.classes_path is not None for frame in scene.frames)
    if labelled and not (job.masks.sky_folder and job.masks.semantic_folder):
        log.info("scene %s: %d of %d images have class maps of the dataset", scene.name, labelled, len(scene.frames))
    sky_known = job.masks.sky_folder is not None or float(np.mean(sky_shares)) >= MIN_SKY
    if not sky_known:
        log.warning(NO_SKY, scene.name)
    return MasksRecord(
        labels=LABELS,
        images=len(scene.frames),
        regions="masks" if job.masks.regions_folder else "boxes",
        sky="masks" if job.masks.sky_folder else "heuristic",
        sky_share=float(np.mean(sky_shares)),
        sky_known=sky_known,
        semantic_classes=max(classes),
        own_car={camera: ego_mask.source.get(camera, "masks") for camera in sorted(seeing)},
        visibility=None if job.masks.regions_folder else visibility_source(scene.tracks),
    )


def _semantic(scene: Scene, frame: Frame, job: MaskJob, body: np.ndarray, folder: Path) -> int:
    """Writes the semantic classes of an image, the user's or the dataset's, if given, unlabelled within the ego
    vehicle's `body` (h, w) bool. Returns the highest class plus one, or 0."""
    size = (body.shape[1], body.shape[0])
    if job.masks.semantic_folder:
        classes = _users_mask(job.masks.semantic_folder, frame, size).copy()
    elif any(other.classes_path is not None for other in scene.frames):
        classes = _datasets_classes(frame, size)
        classes[classes == scene.sky_class] = UNLABELLED  # the sky has no Gaussians
    else:
        return 0
    classes[body] = UNLABELLED
    write_png(folder / mask_name("semantic", frame.camera, frame.timestamp), classes)
    labelled = classes[classes != UNLABELLED]
    return int(labelled.max()) + 1 if len(labelled) else 0


def _datasets_classes(frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """The dataset's classes (h, w) of an image, UNLABELLED where it has none."""
    if frame.classes_path is None:
        return np.full((size[1], size[0]), UNLABELLED, dtype=np.uint8)
    return read_mask(frame.classes_path, size, (frame.width, frame.height)).copy()


def _sky(sweeps: Sequence[Sweep], scene: Scene, frame: Frame, job: MaskJob, size: tuple[int, int]) -> np.ndarray:
    """The sky (h, w) bool of a frame: the user's, that of the dataset's class map, or found by a heuristic, which uses
    the nearest of `sweeps` within the interval of key frames."""
    if job.masks.sky_folder:
        return _users_mask(job.masks.sky_folder, frame, size) > 127
    if frame.classes_path is not None and scene.sky_class is not None:
        return _datasets_classes(frame, size) == scene.sky_class
    lidar = nearest_returns(sweeps, frame.timestamp, scene.key_frame_interval)
    pixels, intrinsics = read_image(frame.image_path, size), continuous_intrinsics(frame, size)
    solid = np.zeros((size[1], size[0]), dtype=bool)  # vehicles that fill their boxes hardly show the sky
    for hull in hulls_in(scene, frame, size):
        if hull.box.object_class.is_solid:
            solid |= fill(hull.polygon, size)
    return sky_mask(pixels, intrinsics, frame.camera_to_world, lidar, solid)


def _users_mask(folder: str, frame: Frame, size: tuple[int, int]) -> np.ndarray:
    return read_mask(users_file(folder, frame), size, (frame.width, frame.height))


def users_file(folder: str, frame: Frame) -> Path:
    """The user's mask of an image: {camera}/{image name}.png or, as the workflow names its own, {camera}/{timestamp in
    microseconds}.png. Raises DatasetError where neither exists."""
    of_camera, name = Path(folder).expanduser() / frame.camera, Path(frame.image_path).stem
    by_name, by_time = of_camera / f"{name}.png", of_camera / f"{frame.timestamp}.png"
    for path in (by_name, by_time):
        if path.is_file():
            return path
    raise DatasetError(f"mask {by_name} is missing, and so is {by_time.name} (docs/masks.md)")


def sky_mask(
    pixels: np.ndarray,
    intrinsics: np.ndarray,
    camera_to_world: np.ndarray,
    lidar: np.ndarray | None,
    solid: np.ndarray | None = None,
) -> np.ndarray:
    """The sky (h, w) bool of an image (h, w, 3) uint8 RGB: pixels above the horizon, bright or blue, smooth, connected
    to the top edge, without LiDAR returns, outside of `solid` (h, w) bool.

    `intrinsics` (3, 3) in the continuous convention; `lidar` (n, 3) world points of the nearest sweep, or None.
    """
    height, width = pixels.shape[:2]
    scale = width / 640.0
    red, green, blue = cv2.split(cv2.GaussianBlur(pixels, (0, 0), max(0.6, scale)))
    brightness = cv2.add(cv2.add(red, green, dtype=cv2.CV_16S), blue, dtype=cv2.CV_16S)  # of at most WHITE
    across, down = (
        cv2.Sobel(brightness, cv2.CV_32F, *direction, borderType=cv2.BORDER_REFLECT) for direction in ((1, 0), (0, 1))
    )
    gradient = cv2.magnitude(across, down) / (8.0 * WHITE)
    candidate = (brightness > MIN_BRIGHTNESS * WHITE) & ((blue >= red) | (brightness > BRIGHT * WHITE))
    candidate &= gradient < SMOOTH / scale
    candidate &= upward_rays((width, height), intrinsics, camera_to_world) > MIN_ELEVATION
    if lidar is not None:
        hit, reach = np.zeros((height, width), dtype=np.uint8), max(1, round(LIDAR_REACH * scale))
        at, depth = project(lidar, np.linalg.inv(camera_to_world), intrinsics)
        inside = (depth > 0.5) & (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
        columns, rows = at[inside].astype(np.int64).T
        hit[rows, columns] = 1
        candidate &= ~cv2.dilate(hit, np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)).astype(bool)
    if solid is not None:
        candidate &= ~solid
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    candidate = cv2.morphologyEx(candidate.astype(np.uint8), cv2.MORPH_OPEN, cross, iterations=max(1, round(scale)))
    count, labels = cv2.connectedComponents(candidate, connectivity=4)
    at_top = np.zeros(count, dtype=bool)
    at_top[labels[: max(1, round(2 * scale))]] = True
    at_top[0] = False
    return at_top[labels]


def relabelled_masks(scene: Scene, job: RegionJob, masks: Path, folder: Path) -> MasksRecord:
    """Writes the masks of every image of a scene below `folder`, given those of the stage `masks` in the folder
    `masks`: regions by the boxes of its tracks, and links to all that depends on no track. Returns their record with
    other regions. Raises ResultError where one of them is damaged."""
    made = read_masks_record(masks)

    def label(frame: Frame) -> None:
        size = target_size(frame, job.images)
        labels = label_image(scene, frame, size)
        labels[read_labels(masks, frame.camera, frame.timestamp, size) == LABELS["own_car"]] = LABELS["own_car"]
        write_png(folder / mask_name("regions", frame.camera, frame.timestamp), labels)

    with ThreadPoolExecutor() as pool:
        list(pool.map(label, scene.frames))
    for name in (mask_name(kind, frame.camera, frame.timestamp) for frame in scene.frames for kind in SHARED):
        if (masks / name).is_file():
            link_or_copy(masks / name, folder / name)
    return dataclasses.replace(made, regions="boxes", visibility=visibility_source(scene.tracks))
