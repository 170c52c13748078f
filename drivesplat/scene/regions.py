"""Static and moving pixels of images, from projected boxes, as the measuring protocol defines them.

A label image gives each pixel one label; a region is a set of labels. Users may supply label images of their own.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene, Track
from drivesplat.scene.tracks import Box, boxes_at

NEAR_PLANE = 0.1
MAX_DISTANCE = 80.0
MIN_PIXELS = 100
MIN_VISIBILITY = 2
UNKNOWN = 0
"""The level of visibility of boxes without an annotated one."""
MAX_HIDDEN = 0.6
"""Maximum share of a hull that nearer boxes hide, for boxes of unknown visibility."""

LABELS = {
    "static": 0,
    "left_out": 1,
    "other": 2,
    "parked_car": 3,
    "moving_car": 4,
    "parked_other_vehicle": 5,
    "moving_other_vehicle": 6,
    "still_human": 7,
    "moving_human": 8,
    "own_car": 9,
}
"""The value of a pixel in a label image. 'other' is an animal, 'own_car' the body of the ego vehicle."""

REGIONS = {
    "all": tuple(name for name in LABELS if name != "own_car"),
    "static": ("static",),
    "vehicle": ("parked_car", "moving_car", "parked_other_vehicle", "moving_other_vehicle"),
    "car": ("parked_car", "moving_car"),
    "moving_vehicle": ("moving_car", "moving_other_vehicle"),
    "parked_vehicle": ("parked_car", "parked_other_vehicle"),
    "moving_human": ("moving_human",),
}
"""The regions of the measuring protocol, as sets of labels."""


@dataclass(frozen=True)
class Hull:
    """A box in an image: `polygon` (n, 2) in continuous pixels, `distance` from camera to box centre in metres."""

    box: Box
    polygon: np.ndarray
    distance: float


def region_mask(labels: np.ndarray, region: str) -> np.ndarray:
    """The pixels (h, w) bool of `region` in a label image (h, w)."""
    return np.isin(labels, [LABELS[name] for name in REGIONS[region]])


def region_masks(labels: np.ndarray) -> dict[str, np.ndarray]:
    """The pixels (h, w) bool of every region in a label image (h, w)."""
    return {region: region_mask(labels, region) for region in REGIONS}


def hull_of(box: Box, world_to_camera: np.ndarray, intrinsics: np.ndarray) -> np.ndarray | None:
    """The convex hull (n, 2), continuous pixels, of a box clipped at the near plane; None if it lies behind.

    `world_to_camera` (4, 4), `intrinsics` (3, 3) in the continuous convention.
    """
    in_camera = box.corners @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    edges = [(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit]
    in_front = in_camera[:, 2] >= NEAR_PLANE
    points = list(in_camera[in_front])
    for a, b in edges:
        if in_front[a] != in_front[b]:
            fraction = (NEAR_PLANE - in_camera[a, 2]) / (in_camera[b, 2] - in_camera[a, 2])
            points.append(in_camera[a] + fraction * (in_camera[b] - in_camera[a]))
    if len(points) < 3:
        return None
    pixels, _ = project(np.array(points), np.eye(4), intrinsics)
    return cv2.convexHull(pixels.astype(np.float32))[:, 0, :]


def hulls_in(scene: Scene, frame: Frame, size: tuple[int, int], all_classes: bool = False) -> list[Hull]:
    """The projected boxes in a frame at `size` (width, height), farthest first: those of dynamic classes, or of
    `all_classes`."""
    world_to_camera = inverse(frame.camera_to_world)
    intrinsics = continuous_intrinsics(frame, size)
    hulls = []
    for box in boxes_at(scene, frame.timestamp):
        wanted = box.object_class.is_dynamic or all_classes
        polygon = hull_of(box, world_to_camera, intrinsics) if wanted else None
        if polygon is not None:
            distance = float(np.linalg.norm(box.object_to_world[:3, 3] - frame.camera_to_world[:3, 3]))
            hulls.append(Hull(box, polygon, distance))
    return sorted(hulls, key=lambda hull: -hull.distance)


def fill(polygon: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The pixels (h, w) bool whose centres lie in a convex polygon (n, 2) of continuous pixels."""
    width, height = size
    x0, y0 = np.floor(np.clip(polygon.min(axis=0), 0, [width, height])).astype(int)
    x1, y1 = np.ceil(np.clip(polygon.max(axis=0), 0, [width, height])).astype(int)
    mask = np.zeros((height, width), dtype=bool)
    x, y = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
    following = np.roll(polygon, -1, axis=0).astype(np.float64)
    sides = [
        (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        for (ax, ay), (bx, by) in zip(polygon.astype(np.float64), following, strict=True)
    ]
    if sides:
        mask[y0:y1, x0:x1] = np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)
    return mask


def owner_image(hulls: list[Hull], size: tuple[int, int]) -> tuple[np.ndarray, list[int]]:
    """The index (h, w) into `hulls` (farthest first) of the nearest box at every pixel, -1 without one; and the number
    of pixels that each hull covers, occluded ones included."""
    owners, covered = np.full((size[1], size[0]), -1), []
    for position, hull in enumerate(hulls):
        mask = fill(hull.polygon, size)
        owners[mask] = position
        covered.append(int(mask.sum()))
    return owners, covered


def label_image(scene: Scene, frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """The label (h, w) uint8 of every pixel of a frame at `size` (width, height), from the scene's boxes.

    Where hulls overlap, the nearer box wins, even if it is left out of the regions.
    """
    _, owners, names = labelled_hulls(scene, frame, size)
    return np.array([LABELS[name] for name in [*names, "static"]], dtype=np.uint8)[owners]


def labelled_hulls(scene: Scene, frame: Frame, size: tuple[int, int]) -> tuple[list[Hull], np.ndarray, list[str]]:
    """The projected boxes of dynamic classes in a frame at `size` (width, height), farthest first; the index (h, w) of
    the nearest one at every pixel, -1 without one; and their labels."""
    hulls, hidden, names = hulls_in(scene, frame, size), set(), []
    owners, covered = owner_image(hulls, size)
    if any(hull.box.visibility == UNKNOWN for hull in hulls):
        # nearer boxes of any class hide them
        of_all = hulls_in(scene, frame, size, all_classes=True)
        nearest, counts = owner_image(of_all, size)
        visible = np.bincount(nearest[nearest >= 0], minlength=len(of_all)).tolist()
        for hull, seen, count in zip(of_all, visible, counts, strict=True):
            if hull.box.visibility == UNKNOWN and count and 1.0 - seen / count > MAX_HIDDEN:
                hidden.add(hull.box.track_id)
    for hull, pixels in zip(hulls, covered, strict=True):
        box = hull.box
        unseen = box.track_id in hidden or UNKNOWN < box.visibility < MIN_VISIBILITY
        if unseen or hull.distance > MAX_DISTANCE or pixels < MIN_PIXELS:
            name = "left_out"
        elif box.object_class.is_vehicle:
            kind = "car" if box.object_class is ObjectClass.CAR else "other_vehicle"
            name = f"moving_{kind}" if box.moves else f"parked_{kind}"
        elif box.object_class.is_human:
            name = "moving_human" if box.moves else "still_human"
        else:
            name = "other"
        names.append(name)
    return hulls, owners, names


def visibility_source(tracks: Iterable[Track]) -> Literal["annotated", "estimated"] | None:
    """Whether the visibility of all boxes of dynamic classes is annotated, or that of at least one is estimated from
    nearer boxes; None without such boxes."""
    levels = [track.visibility for track in tracks if track.object_class.is_dynamic]
    if not levels:
        return None
    return "estimated" if any((level == UNKNOWN).any() for level in levels) else "annotated"
