"""The picture of a drive of LiDAR alone: a sweep and the boxes, seen from above."""

import numpy as np
from PIL import Image, ImageDraw

from drivesplat.readers.sweeps import read_returns, sweep_fault
from drivesplat.scene.rigid import apply
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import boxes_at

REACH = 50.0
"""Metres from the LiDAR to the sides of the picture."""
HEIGHTS = -2.0, 4.0
"""Metres relative to the LiDAR at which the colour of returns begins and ends."""
FOOTPRINT = (0, 2, 6, 4)
"""The lower corners of a box in order, as indices of `Box.corners`."""


def seen_from_above(scene: Scene, width: int) -> Image.Image:
    """The middle sweep in a square picture of `width` pixels, x of the world to the right and y up: returns coloured by
    height, boxes outlined."""
    image = Image.new("RGB", (width, width))
    draw, sweep = ImageDraw.Draw(image), sorted(scene.sweeps, key=lambda sweep: sweep.timestamp)[len(scene.sweeps) // 2]
    center = sweep.sensor_to_world[:3, 3]

    def pixels(points: np.ndarray) -> np.ndarray:
        return (points[:, :2] - center[:2]) * [1, -1] * width / (2 * REACH) + width / 2

    if sweep_fault(sweep) is None:
        points = apply(sweep.sensor_to_world, read_returns(sweep).points)
        low, high = HEIGHTS
        shares = np.clip((points[:, 2] - center[2] - low) / (high - low), 0.0, 1.0)
        colors = (255 * np.stack([shares, np.minimum(1.0, 2 * (1 - shares)), 1 - shares], axis=1)).astype(np.uint8)
        at = np.floor(pixels(points)).astype(np.int64)
        inside = ((at >= 0) & (at < width)).all(axis=1)
        canvas = np.zeros((width, width, 3), dtype=np.uint8)
        canvas[at[inside, 1], at[inside, 0]] = colors[inside]
        image.paste(Image.fromarray(canvas))
    for box in boxes_at(scene, sweep.timestamp):
        corners = pixels(box.corners[list(FOOTPRINT)])
        draw.polygon([tuple(corner) for corner in corners], outline=(255, 90, 0), width=2)
    draw.text((8, 8), f"{sweep.lidar} at {sweep.timestamp}, {2 * REACH:g} m wide", fill=(255, 255, 255))
    return image
