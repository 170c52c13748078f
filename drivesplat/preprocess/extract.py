"""The stage `extract`: a dataset's tables into one checked `scene.json`."""

import dataclasses
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from drivesplat.errors import DatasetError
from drivesplat.readers.datasets import reader
from drivesplat.scene.scene import Frame, Scene, place_of
from drivesplat.scene.scene_warnings import luminance, scene_warnings
from drivesplat.settings.extract import SceneSource

log = logging.getLogger(__name__)

MAX_NAMED = 10
"""Of images that are left out, so many are named one by one."""


def extract_scene(source: SceneSource, root: Path, scene_tables: Path | None = None) -> Scene:
    """The scene, read and checked, its images decoded once. `root` holds the folder of tables, `scene_tables` what the
    scene needs of them (None: it is looked for). What a reader of the figures has to know of the drive is logged as
    warnings.

    Raises DatasetError naming the token and path of what is wrong.
    """
    scene = reader(source.reader).read(root, source, scene_tables)
    with ThreadPoolExecutor() as pool:
        faults = list(pool.map(image_fault, scene.frames))
    bad = [(frame, fault) for frame, fault in zip(scene.frames, faults, strict=True) if fault]
    if bad and source.on_missing == "stop":
        raise DatasetError(_remedied(*bad[0]))
    for frame, fault in bad[:MAX_NAMED]:
        log.warning("%s: %s; left out", place_of(frame), fault)
    if len(bad) > MAX_NAMED:
        log.warning("%d more of %d images are missing or corrupt; left out", len(bad) - MAX_NAMED, len(scene.frames))
    kept = tuple(frame for frame, fault in zip(scene.frames, faults, strict=True) if not fault)
    if not kept:
        raise DatasetError(
            f"scene {source.scene}: none of its {len(scene.frames)} images can be read (first: "
            f"{scene.frames[0].image_path})"
        )
    scene = dataclasses.replace(scene, dataset=source.dataset, frames=kept, missing_images=len(bad))
    for sentence in scene_warnings(scene, luminance(scene)):
        log.warning("scene %s: %s", scene.name, sentence)
    return scene


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


def _remedied(frame: Frame, fault: str) -> str:
    """What to do about a frame's fault, which stops the extraction."""
    leave_out = "" if frame.is_key_frame else "sweeps: false to do without all images between key frames, or "
    return (
        f"{place_of(frame)} ({frame.camera}): {fault}; "
        f"restore the file, or set {leave_out}extract.on_missing: warn to go on without it"
    )
