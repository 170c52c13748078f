"""The check of a drive folder: every fault in a sentence, and a picture with LiDAR and boxes in images."""

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from drivesplat.readers.check_picture import write_picture
from drivesplat.readers.drive.faults import faults_of
from drivesplat.readers.drive.format import FILE, Drive, structure_of
from drivesplat.readers.drive.reader import scene_of
from drivesplat.readers.recorded_files import faults_of_images, faults_of_sweeps, said_once
from drivesplat.scene.scene import Scene
from drivesplat.settings.extract import SceneSource


class Examined(NamedTuple):
    """What a check found: faults of a folder, its scene unless drive.json has faults, and why there is no picture."""

    faults: list[str]
    scene: Scene | None = None
    no_picture: str | None = None


def check(folder: Path, picture: Path | None) -> list[str]:
    """The faults of a drive folder, a sentence each, with the picture that `examine` draws."""
    return examine(folder, picture).faults


def examine(folder: Path, picture: Path | None) -> Examined:
    """Checks a drive folder. Without faults of drive.json, and with a path for it, draws a picture: for every camera a
    key frame with boxes and the nearest sweep, and again with sweeps 1.5 s earlier and later; without images the middle
    sweep from above. An older picture is removed."""
    if picture is not None:
        with suppress(OSError):  # writing the new one finds the same fault
            picture.unlink(missing_ok=True)
    faults, drive = structure_of(folder / FILE)
    faults = faults if drive is None else [f"{folder / FILE}: {fault}" for fault in faults_of(drive)]
    if drive is None or faults:
        return Examined(faults)
    scene = whole_scene(drive, folder)
    of_sweeps = faults_of_sweeps(scene.sweeps)
    faults += [*said_once(scene.frames, faults_of_images(scene.frames)), *filter(None, of_sweeps)]
    no_picture = None
    if picture is not None:
        sound = [sweep for sweep, fault in zip(scene.sweeps, of_sweeps, strict=True) if not fault]
        no_picture = write_picture(scene, sound, picture)
    return Examined(faults, scene, no_picture)


def whole_scene(drive: Drive, folder: Path) -> Scene:
    """All images and sweeps of a drive without faults."""
    return scene_of(
        drive, folder,
        SceneSource(
            dataset="", reader="drive", version="", scene=folder.name, frames=None, cameras=tuple(drive.cameras),
            sweeps=True, lidar_sweeps=True, on_missing="stop",
        ),
    )  # fmt: skip
