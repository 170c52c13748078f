"""Viewing rays of pixels, computed one step after the other."""

import numpy as np


def pixel_rays(size: tuple[int, int], intrinsics: np.ndarray, camera_to_world: np.ndarray) -> np.ndarray:
    """The unit viewing directions (h, w, 3) of the pixel centres of an image of `size` (width, height), in world
    coordinates."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(intrinsics).T @ camera_to_world[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
