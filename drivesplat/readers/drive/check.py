"""The check of a drive folder: every fault in a sentence, and a picture with LiDAR and boxes in images."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from drivesplat.readers.drive.faults import faults_of
from drivesplat.readers.drive.format import FILE, Drive, structure_of
from drivesplat.readers.drive.from_above import seen_from_above
from drivesplat.readers.drive.reader import scene_of
from drivesplat.readers.drive.sweep_file import columns_sentence
from drivesplat.readers.image_file import image_fault
from drivesplat.readers.sweeps import read_returns, sweep_fault
from drivesplat.scene.images import continuous_intrinsics, project, read_image
from drivesplat.scene.regions import hulls_in
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import UNPOSED, Frame, Scene, Sweep
from drivesplat.settings.extract import SceneSource

WIDTH = 960
"""Width of an image in the picture."""
NO_IMAGES = "no images: methods that render LiDAR are trained and measured with cameras: [] (docs/lidar.md)"
MAX_DEPTH = 60.0
"""Metres at which the colour of returns ends."""
OTHER_TIMES = (-1_500_000, 1_500_000)
"""Microseconds from an image to the sweeps that test the poses."""
SCALE_STEPS = 6
"""Colours in the legend of distances."""


def check(folder: Path, picture: Path | None) -> list[str]:
    """The faults of a drive folder, a sentence each. Without faults of drive.json, and with a path for it, writes a
    picture: for every camera its middle key frame with boxes and the nearest sweep, and again with sweeps 1.5 s earlier
    and later. Without images: the middle sweep from above."""
    if picture is not None:
        picture.unlink(missing_ok=True)
    faults, drive = structure_of(folder / FILE)
    if drive is None:
        return faults
    faults = [f"{folder / FILE}: {fault}" for fault in faults_of(drive)]
    if faults:
        return faults
    scene = whole_scene(drive, folder)
    of_sweeps = [sweep_fault(sweep) for sweep in scene.sweeps]
    if picture is not None:
        sound = [sweep for sweep, fault in zip(scene.sweeps, of_sweeps, strict=True) if not fault]
        write_picture(scene, sound, picture)
    return [*_image_faults(scene), *filter(None, of_sweeps)]


def whole_scene(drive: Drive, folder: Path) -> Scene:
    """All images and sweeps of a drive without faults."""
    return scene_of(
        drive, folder,
        SceneSource(
            dataset="", reader="drive", version="", scene=folder.name, frames=None, cameras=tuple(drive.cameras),
            sweeps=True, lidar_sweeps=True, on_missing="stop",
        ),
    )  # fmt: skip


def summary(scene: Scene) -> str:
    """What a drive holds, in a sentence."""
    key_frames = len(scene.key_frame_timestamps)
    parts = [
        f"{key_frames} key frames at {scene.key_frame_hz:g} Hz",
        f"{len(scene.frames)} images of {len(scene.cameras)} cameras" if scene.frames else NO_IMAGES,
        f"{len(scene.sweeps)} LiDAR sweeps" if scene.sweeps else "no LiDAR",
        *(["no poses: set refine_poses: {enabled: true, start: images}"] if scene.poses == UNPOSED else []),
        f"{len(scene.tracks)} tracks" if scene.tracks else "no boxes: all is treated as static",
    ]
    return ", ".join(parts)


def column_sentences(scene: Scene) -> list[str]:
    """What is read from the first sweep of each LiDAR, which has no fault."""
    firsts = [next(sweep for sweep in scene.sweeps if sweep.lidar == lidar.name) for lidar in scene.lidars]
    return [f"LiDAR {sweep.lidar}: {Path(sweep.path).name} {columns_sentence(Path(sweep.path))}" for sweep in firsts]


def _image_faults(scene: Scene) -> Iterator[str]:
    for frame in scene.frames:
        if fault := image_fault(frame):
            yield f"frame {frame.token}: {fault}"


def write_picture(scene: Scene, sweeps: Sequence[Sweep], path: Path) -> None:
    """Writes the middle key frames of all cameras, one below the other, or without images the middle sweep. `sweeps`
    are those without faults."""
    images = []
    for camera in scene.cameras:
        indices = scene.key_frames(camera.name)
        if indices:
            frame = scene.frames[sorted(indices)[len(indices) // 2]]
            images += [
                _drawn(scene, sweeps, frame, offsets) for offsets in ((0,), OTHER_TIMES)[: 2 if scene.sweeps else 1]
            ]
    if not scene.frames and scene.sweeps:
        images.append(seen_from_above(scene, WIDTH))
    if not images:
        return
    canvas = Image.new("RGB", (WIDTH, sum(image.height for image in images)))
    top = 0
    for image in images:
        canvas.paste(image, (0, top))
        top += image.height
    canvas.save(path)


def _drawn(scene: Scene, sweeps: Sequence[Sweep], frame: Frame, offsets: Sequence[int]) -> Image.Image:
    """An image with boxes, and with the returns of the sweeps nearest to its time plus `offsets` (microseconds)."""
    size = WIDTH, round(WIDTH * frame.height / frame.width)
    image = Image.new("RGB", size) if image_fault(frame) else Image.fromarray(read_image(frame.image_path, size))
    draw, seconds = ImageDraw.Draw(image), []
    for offset in offsets if sweeps else ():
        sweep = min(sweeps, key=lambda sweep: abs(sweep.timestamp - frame.timestamp - offset))
        _draw_returns(draw, apply(sweep.sensor_to_world, read_returns(sweep).points), frame, size)
        seconds.append(f"{(sweep.timestamp - frame.timestamp) * 1e-6:+.2f} s")
    for hull in hulls_in(scene, frame, size):
        draw.polygon([tuple(corner) for corner in hull.polygon], outline=(255, 90, 0), width=2)
    text = [f"{frame.camera} at {frame.timestamp}", *([f"returns at {' and '.join(seconds)}"] if seconds else [])]
    outlined = {"fill": (255, 255, 255), "stroke_width": 2, "stroke_fill": (0, 0, 0)}
    draw.text((8, 8), ", ".join(text), **outlined)
    for step in range(SCALE_STEPS + 1 if seconds else 0):
        share = step / SCALE_STEPS
        draw.rectangle((8 + 60 * step, 26, 20 + 60 * step, 38), fill=_color(share))
        draw.text((24 + 60 * step, 26), f"{share * MAX_DEPTH:.0f} m", **outlined)
    return image


def _draw_returns(draw: ImageDraw.ImageDraw, points: np.ndarray, frame: Frame, size: tuple[int, int]) -> None:
    pixels, depth = project(points, inverse(frame.camera_to_world), continuous_intrinsics(frame, size))
    inside = (depth > 0.5) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)
    shares = np.clip(depth[inside] / MAX_DEPTH, 0.0, 1.0)
    for (x, y), share in zip(pixels[inside], shares, strict=True):
        draw.ellipse((x - 1, y - 1, x + 1, y + 1), fill=_color(share))


def _color(share: float) -> tuple[int, int, int]:
    """The colour of a distance, as a share of MAX_DEPTH."""
    return int(255 * (1 - share)), int(255 * min(1.0, 2 * share)), int(255 * share)
