"""The stage `extract`: a dataset's tables into one checked `scene.json`."""

import dataclasses
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from drivesplat.errors import DatasetError
from drivesplat.readers import reader
from drivesplat.scene import Frame, Scene
from drivesplat.settings.extract import SceneSource

log = logging.getLogger(__name__)


def extract_scene(source: SceneSource, root: Path) -> Scene:
    """The scene, read and checked, its images decoded once. `root` holds the folder of tables.

    Raises DatasetError naming the token and path of what is wrong.
    """
    scene = reader(source.reader).read(root, source.version, source.scene, source.cameras, source.sweeps, source.frames)
    with ThreadPoolExecutor() as pool:
        faults = list(pool.map(image_fault, scene.frames))
    for frame, fault in zip(scene.frames, faults, strict=True):
        if fault and source.on_missing == "stop":
            raise DatasetError(
                f"{_named(frame)}: {fault}; restore the file, or set extract.on_missing: warn to go on without it"
            )
        if fault:
            log.warning("%s: %s; left out", _named(frame), fault)
    kept = tuple(frame for frame, fault in zip(scene.frames, faults, strict=True) if not fault)
    if not kept:
        raise DatasetError(
            f"scene {source.scene}: none of its {len(scene.frames)} images can be read (first: "
            f"{scene.frames[0].image_path})"
        )
    return dataclasses.replace(scene, dataset=source.dataset, frames=kept, missing_images=len(scene.frames) - len(kept))


def image_fault(frame: Frame) -> str | None:
    """What is wrong with a frame's image file, or None.

    Decodes it, at reduced size, since a truncated JPEG opens well.
    """
    path = Path(frame.image_path)
    if not path.is_file():
        return f"image {path} is missing"
    try:
        with Image.open(path) as image:
            if image.size != (frame.width, frame.height):
                return f"image {path} is {image.size[0]}x{image.size[1]}, the tables say {frame.width}x{frame.height}"
            image.draft("RGB", (frame.width // 8, frame.height // 8))
            image.load()
    except (OSError, UnidentifiedImageError, SyntaxError) as error:
        return f"image {path} is corrupt ({error})"
    return None


def _named(frame: Frame) -> str:
    return f"key frame {frame.sample_index}, sample_data {frame.token} ({frame.camera})"
