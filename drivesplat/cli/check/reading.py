"""Reads the recording that is checked: all of its records, and the files of as many recordings as the checks need."""

import dataclasses
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivesplat.cli.check.chosen import ChosenScene
from drivesplat.errors import DatasetError
from drivesplat.readers.datasets import index, layout, missing_package, reader, reads_unposed, unpacker
from drivesplat.readers.recorded_files import faults_of_images, faults_of_sweeps, said_once
from drivesplat.readers.sampled_sweeps import pairs_of_sweeps
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.extract import SceneSource

SPREAD = 12
"""Images of each camera, from the first to the last, of which a sample has files."""


@dataclass(frozen=True)
class CheckedScene:
    """A recording: `at_hand` has the images and sweeps whose files can be read, `whole` also those that were not opened
    where these are a sample, of `opened` images and sweeps. `faults_of_images` and `faults_of_sweeps` are about files
    that cannot be read."""

    whole: Scene
    at_hand: Scene
    faults_of_images: list[str]
    faults_of_sweeps: list[str]
    opened: tuple[int, int] | None = None


def read_recording(chosen: ChosenScene, folder: Path) -> CheckedScene:
    """Reads a recording. What must be written for that goes into the empty `folder`: a scene's rows of large tables,
    and of recordings that are no files of their own a sample. Raises DatasetError naming the first fault of its
    records."""
    if problem := missing_package(chosen.reader):
        raise DatasetError(problem)
    cameras = tuple(layout(chosen.reader).camera_names(chosen.root, chosen.version))
    scene = _read(chosen, cameras, folder)
    recording = {frame.camera for frame in scene.frames}
    scene = dataclasses.replace(scene, cameras=tuple(one for one in scene.cameras if one.name in recording))
    if not scene.frames and not scene.sweeps:
        raise DatasetError(f"scene {chosen.name}: it has neither images nor LiDAR sweeps")
    files = unpacker(chosen.reader)
    if files is None:
        return _with_files(scene, scene)
    sample = dataclasses.replace(
        scene, frames=tuple(_sampled_frames(scene)), sweeps=tuple(pairs_of_sweeps(scene, scene.sweeps))
    )
    sample = files.unpack(sample, chosen.root, _source(chosen, cameras), folder)
    images = {frame.token: frame for frame in sample.frames}
    sweeps = {sweep.token: sweep for sweep in sample.sweeps}
    scene = dataclasses.replace(
        scene,
        frames=tuple(images.get(frame.token, frame) for frame in scene.frames),
        sweeps=tuple(sweeps.get(sweep.token, sweep) for sweep in scene.sweeps),
        sky_class=sample.sky_class,
    )
    return _with_files(scene, sample, (len(sample.frames), len(sample.sweeps)))


def _source(chosen: ChosenScene, cameras: tuple[str, ...]) -> SceneSource:
    return SceneSource(
        dataset=chosen.dataset, reader=chosen.reader, version=chosen.version, scene=chosen.name, frames=chosen.frames,
        cameras=cameras, sweeps=True, lidar_sweeps=True, poses_from_images=reads_unposed(chosen.reader),
        on_missing="warn",
    )  # fmt: skip


def _read(chosen: ChosenScene, cameras: tuple[str, ...], folder: Path) -> Scene:
    """All records of a recording. `cameras` are those of its dataset: of these the ones that the scene has are read."""
    tables = index(chosen.reader)
    rows = None
    if tables is not None:
        tables.index_tables(chosen.root, chosen.version, (chosen.name,), folder)
        rows = tables.scene_file(folder, chosen.name)

    def read(names: tuple[str, ...]) -> Scene:
        return reader(chosen.reader).read(chosen.root, _source(chosen, names), rows)

    def has(name: str) -> bool:
        try:
            return bool(read((name,)).frames)
        except DatasetError:
            return False

    outline = getattr(layout(chosen.reader), "outline", lambda *_: None)(chosen.root, chosen.version, chosen.name)
    if outline is not None:
        return read(tuple(name for name in cameras if name in outline.cameras))
    try:
        return read(cameras)
    except DatasetError:
        own = tuple(filter(has, cameras))
        if len(own) in (0, len(cameras)):
            raise
        return read(own)


def _with_files(scene: Scene, sample: Scene, opened: tuple[int, int] | None = None) -> CheckedScene:
    of_images, of_sweeps = faults_of_images(sample.frames), faults_of_sweeps(sample.sweeps)
    at_hand = dataclasses.replace(
        sample,
        frames=tuple(one for one, fault in zip(sample.frames, of_images, strict=True) if not fault),
        sweeps=tuple(one for one, fault in zip(sample.sweeps, of_sweeps, strict=True) if not fault),
    )
    if opened is None:
        scene = at_hand
    said = said_once(sample.frames, of_images)
    return CheckedScene(scene, at_hand, said, list(filter(None, of_sweeps)), opened)


def _sampled_frames(scene: Scene) -> list[Frame]:
    """Of each camera images from the first to the last, those nearest to the sampled sweeps, and those by which its
    lens is judged."""
    times = sorted({sweep.timestamp for sweep in pairs_of_sweeps(scene, scene.sweeps)})
    found: dict[str, Frame] = {}
    for camera in scene.cameras:
        own = sorted((f for f in scene.frames if f.camera == camera.name), key=lambda frame: frame.timestamp)
        at = [own[i] for i in np.unique(np.linspace(0, len(own) - 1, SPREAD).round().astype(int))]
        at += [min(own, key=lambda frame: abs(frame.timestamp - time)) for time in times]
        found |= {frame.token: frame for frame in at}
    with suppress(ImportError):  # pycolmap, which a warning names
        from drivesplat.preprocess.poses.lens import with_tested_images

        tested = {frame.token for frame in with_tested_images(scene).frames}
        found |= {frame.token: frame for frame in scene.frames if frame.token in tested}
    return list(found.values())


def mean_rate(timestamps: Sequence[int]) -> float | None:
    """The usual rate in Hz of recordings at `timestamps` in microseconds; None for one alone."""
    steps = np.diff(np.sort(np.array(timestamps, dtype=np.int64)))
    return 1e6 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else None
