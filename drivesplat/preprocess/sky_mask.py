"""Sky detection: pixels above the horizon, bright or blue, smooth, connected to the top edge, without LiDAR returns."""

import cv2
import numpy as np
from scipy import ndimage

from drivesplat.scene.images import pixel_rays, project

MIN_ELEVATION = np.sin(np.radians(1.0))
"""Sine of the minimum elevation of sky, one degree above the horizon."""
MIN_BRIGHTNESS = 0.35
"""Minimum brightness of sky with a blue tint, in [0, 1]."""
BRIGHT = 0.7
"""Minimum brightness of sky without a blue tint (overcast)."""
SMOOTH = 0.045
"""Maximum brightness gradient of sky, per pixel at 640 pixels' width."""
LIDAR_REACH = 12
"""Distance from a LiDAR return within which no pixel is sky, in pixels at 640 pixels' width."""


def sky_mask(
    pixels: np.ndarray, intrinsics: np.ndarray, camera_to_world: np.ndarray, lidar: np.ndarray | None
) -> np.ndarray:
    """The sky (h, w) bool of an image (h, w, 3) uint8 RGB.

    `intrinsics` (3, 3) in the continuous convention; `lidar` (n, 3) world points of the nearest sweep, or None.
    """
    height, width = pixels.shape[:2]
    scale = width / 640.0
    smoothed = cv2.GaussianBlur(pixels, (0, 0), max(0.6, scale)).astype(np.float64) / 255.0
    brightness = smoothed.mean(axis=2)
    gradient = np.hypot(ndimage.sobel(brightness, axis=0), ndimage.sobel(brightness, axis=1)) / 8.0 * scale
    blue = smoothed[..., 2] >= smoothed[..., 0]
    candidate = (brightness > MIN_BRIGHTNESS) & (blue | (brightness > BRIGHT)) & (gradient < SMOOTH)
    candidate &= pixel_rays((width, height), intrinsics, camera_to_world)[..., 2] > MIN_ELEVATION
    if lidar is not None:
        candidate &= ~_near_returns(
            lidar, np.linalg.inv(camera_to_world), intrinsics, (height, width), max(1, round(LIDAR_REACH * scale))
        )
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    candidate = cv2.morphologyEx(candidate.astype(np.uint8), cv2.MORPH_OPEN, cross, iterations=max(1, round(scale)))
    labels, _ = ndimage.label(candidate)
    at_top = np.unique(labels[: max(1, round(2 * scale))])
    return np.isin(labels, at_top[at_top > 0])


def _near_returns(
    lidar: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray, shape: tuple[int, int], reach: int
) -> np.ndarray:
    hit = np.zeros(shape, dtype=np.uint8)
    at, depth = project(lidar, world_to_camera, intrinsics)
    inside = (depth > 0.5) & (at >= 0).all(axis=1) & (at[:, 0] < shape[1]) & (at[:, 1] < shape[0])
    columns, rows = at[inside].astype(np.int64).T
    hit[rows, columns] = 1
    return cv2.dilate(hit, np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)).astype(bool)
