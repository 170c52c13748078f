"""A picture with LiDAR returns and boxes in images, by which a drive is looked at before it is trained on."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from drivesplat.readers.image_file import image_fault
from drivesplat.readers.sweeps import read_returns, sweep_fault
from drivesplat.scene.images import continuous_intrinsics, project, read_image
from drivesplat.scene.regions import hulls_in
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import Frame, Scene, Sweep
from drivesplat.scene.tracks import boxes_at

WIDTH, MAX_WIDTH, FONT = 960, 1920, 14
"""Width of an image in a picture of one camera, and of the whole picture of several; height of its labels, in pixels.
"""
NEAREST_US = 20_000
"""Steps in microseconds in which the time between an image and a sweep counts for the choice of the image."""
MAX_DEPTH = 60.0
"""Metres at which the colour of returns ends."""
OTHER_TIMES = (-1_500_000, 1_500_000)
"""Microseconds from an image to the sweeps that test the poses."""
SCALE_STEPS = 6
"""Colours in the legend of distances."""
SIDE_DISTANCE = 50.0
"""Metres from the LiDAR to the sides of a picture from above."""
COLORED_HEIGHTS = -2.0, 4.0
"""Metres relative to the LiDAR at which the colour of returns begins and ends."""
FOOTPRINT = (0, 2, 6, 4)
"""The lower corners of a box in order, as indices of `Box.corners`."""


def write_picture(scene: Scene, sweeps: Sequence[Sweep], path: Path) -> str | None:
    """Writes a key frame of every camera, in a grid, or without images the middle sweep. The key frame is nearest to a
    sweep in time, within NEAREST_US, and then to the middle. `sweeps` are those without faults. Returns a sentence if
    the file cannot be written."""
    cameras = [camera.name for camera in scene.cameras if scene.key_frames(camera.name)]
    columns = max(1, math.ceil(math.sqrt(len(cameras))))
    width = WIDTH if columns == 1 else MAX_WIDTH // columns
    tiles, sweep_times = [], np.array([sweep.timestamp for sweep in sweeps])
    for camera in cameras:
        frames = sorted((scene.frames[i] for i in scene.key_frames(camera)), key=lambda frame: frame.timestamp)
        gaps = [int(np.abs(sweep_times - f.timestamp).min()) // NEAREST_US if sweeps else 0 for f in frames]
        ranks = [(gap, abs(i - len(frames) // 2)) for i, gap in enumerate(gaps)]
        frame = frames[ranks.index(min(ranks))]
        offsets = ((0,), OTHER_TIMES)[: 2 if scene.sweeps else 1]
        tiles.append(_stacked([[_drawn(scene, sweeps, frame, times, width)] for times in offsets]))
    if not scene.frames and scene.sweeps:
        tiles.append(seen_from_above(scene, WIDTH))
    if not tiles:
        return None
    try:
        _stacked([tiles[i : i + columns] for i in range(0, len(tiles), columns)]).save(path)
    except OSError as error:
        return f"{path.name} cannot be written there ({error.strerror or error}); --picture names another place"
    return None


def _stacked(rows: Sequence[Sequence[Image.Image]]) -> Image.Image:
    """Images beside each other in rows, one below the other."""
    heights = [max(image.height for image in row) for row in rows]
    canvas = Image.new("RGB", (max(sum(image.width for image in row) for row in rows), sum(heights)))
    for row, top in zip(rows, np.cumsum([0, *heights]), strict=False):
        left = 0
        for image in row:
            canvas.paste(image, (left, int(top)))
            left += image.width
    return canvas


def _drawn(scene: Scene, sweeps: Sequence[Sweep], frame: Frame, offsets: Sequence[int], width: int) -> Image.Image:
    """An image of `width` pixels with boxes, and the returns of the sweeps nearest to its time plus `offsets`
    (microseconds)."""
    size = width, max(1, round(width * frame.height / frame.width))
    image = Image.new("RGB", size) if image_fault(frame) else Image.fromarray(read_image(frame.image_path, size))
    draw, seconds = ImageDraw.Draw(image), []
    for offset in offsets if sweeps else ():
        sweep = min(sweeps, key=lambda sweep: abs(sweep.timestamp - frame.timestamp - offset))
        points = apply(sweep.sensor_to_world, read_returns(sweep).points)
        pixels, depth = project(points, inverse(frame.camera_to_world), continuous_intrinsics(frame, size))
        inside = (depth > 0.5) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)
        for (x, y), share in zip(pixels[inside], np.clip(depth[inside] / MAX_DEPTH, 0.0, 1.0), strict=True):
            draw.ellipse((x - 1, y - 1, x + 1, y + 1), fill=_color(share))
        seconds.append(f"{(sweep.timestamp - frame.timestamp) * 1e-6:+.2f} s")
    for hull in hulls_in(scene, frame, size):
        draw.polygon([tuple(corner) for corner in hull.polygon], outline=(255, 90, 0), width=2)
    text = [f"{frame.camera} at {frame.timestamp}", *([f"returns at {' and '.join(seconds)}"] if seconds else [])]
    font = ImageFont.load_default(FONT)
    outlined = {"fill": (255, 255, 255), "stroke_width": 1, "stroke_fill": (0, 0, 0), "font": font}
    draw.text((8, 8), ", ".join(text), **outlined)
    for step in range(SCALE_STEPS + 1 if seconds else 0):
        share = step / SCALE_STEPS
        draw.rectangle((8 + 60 * step, 26, 20 + 60 * step, 38), fill=_color(share))
        draw.text((24 + 60 * step, 26), f"{share * MAX_DEPTH:.0f} m", **outlined)
    return image


def _color(share: float) -> tuple[int, int, int]:
    """The colour of a distance, as a share of MAX_DEPTH."""
    return int(255 * (1 - share)), int(255 * min(1.0, 2 * share)), int(255 * share)


def seen_from_above(scene: Scene, width: int) -> Image.Image:
    """The middle sweep in a square picture of `width` pixels, x of the world to the right and y up: returns coloured by
    height, boxes outlined."""
    image = Image.new("RGB", (width, width))
    draw, sweep = ImageDraw.Draw(image), sorted(scene.sweeps, key=lambda sweep: sweep.timestamp)[len(scene.sweeps) // 2]
    center = sweep.sensor_to_world[:3, 3]

    def pixels(points: np.ndarray) -> np.ndarray:
        return (points[:, :2] - center[:2]) * [1, -1] * width / (2 * SIDE_DISTANCE) + width / 2

    if sweep_fault(sweep) is None:
        points = apply(sweep.sensor_to_world, read_returns(sweep).points)
        low, high = COLORED_HEIGHTS
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
    draw.text((8, 8), f"{sweep.lidar} at {sweep.timestamp}, {2 * SIDE_DISTANCE:g} m wide", fill=(255, 255, 255))
    return image
