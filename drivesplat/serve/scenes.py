"""The trained drives that are served: which there are, and which are loaded."""

import gc
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch

from drivesplat.drive.packed_drive import packed_scene_id, unpack_drive
from drivesplat.drive.trained_drive import TrainedDrive, open_drive
from drivesplat.editing.ego import MAX_LEAD
from drivesplat.errors import DeviceError, RequestError
from drivesplat.model.checkpoint import CHECKPOINT, model_file
from drivesplat.scene.blocks import Blocks, blocks_left_out, drive_scene, read_blocks
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask, read_ego_mask
from drivesplat.scene.scene import Scene
from drivesplat.serve.faults import ServiceError, as_service_errors
from drivesplat.serve.poses import FrameTimes
from drivesplat.serve.requests import ScenePlace
from drivesplat.settings.blocks import BLOCKS, drive_of
from drivesplat.trajectories.edited_actors import EditedActor

MASK_FILE, ARCHIVE = "own_car.json", "scene.alpasim.usdz"


@dataclass(frozen=True)
class DriveSource:
    """A trained drive that can be opened: the result folder of a `method` of a `scene`. `archive_id` is its id in
    scene.alpasim.usdz (None: there is no such file)."""

    scene: str
    method: str
    folder: Path
    archive_id: str | None = None

    @classmethod
    def of(cls, folder: Path) -> "DriveSource":
        """The source of a method's result folder. Raises ResultError for a damaged archive in it."""
        resolved, archive = folder.resolve(), folder / ARCHIVE
        own = packed_scene_id(archive, folder / CHECKPOINT) if archive.is_file() else None
        return cls(resolved.parent.name, resolved.name, folder, own)

    @classmethod
    def packed(cls, archive: Path) -> "DriveSource":
        """The source of a drive in an archive, which is unpacked. Raises ResultError where this fails."""
        return replace(cls.of(unpack_drive(archive)), archive_id=packed_scene_id(archive))

    @property
    def full_name(self) -> str:
        """Scene and method."""
        return f"{self.scene}/{self.method}"

    @cached_property
    def ego_mask(self) -> EgoMask:
        """The outlines of the vehicle's own body, which are read without the model."""
        file = self.folder.resolve().parent / MASK_FILE
        return read_ego_mask(file)[0] if file.is_file() else NO_EGO_MASK

    def open(self, device: str) -> TrainedDrive:
        """Reads the model onto a device."""
        return open_drive(self.folder, device)


@dataclass(frozen=True)
class LongDriveSource:
    """A drive that was cut into blocks, of which all or some are served: `scene_ids` are the ids of these, by number.
    `folder` is results/{scene}. A block that the figures of the drive leave out is a scene of its own alone."""

    folder: Path
    blocks: Blocks
    scene_ids: Mapping[int, str]

    @property
    def first(self) -> str:
        """The id of its first block that is served."""
        return self.scene_ids[min(self.scene_ids)]

    @cached_property
    def record(self) -> Scene:
        """The scene of the whole drive."""
        return drive_scene(self.folder, self.blocks)

    def place(self, scene_id: str, times: FrameTimes) -> ScenePlace:
        """The block in which the vehicle is at the moment that a frame shows. Raises ServiceError (NOT_FOUND) for one
        that is not served."""
        number = self.blocks.at(times.shown_us[0])
        if number not in self.scene_ids:
            raise ServiceError(
                "NOT_FOUND", f"block {number} of {scene_id} is not served, or left out: {self.blocks.names[number]}"
            )
        return ScenePlace(self.scene_ids[number], self.blocks.blocks[number].origin)


def find_sources(paths: Iterable[Path]) -> dict[str, DriveSource]:
    """The trained drives of result folders (all trained methods of all scenes below), of methods' folders, and of
    scenes for AlpaSim (`*.usdz`, also those of a folder that has nothing else), by scene id: the name of the scene, or
    `scene/method` where several methods of a scene are served.

    Raises RequestError for a path without any, and for two scenes of one name in different folders; ResultError for a
    damaged archive.
    """
    sources = {source.folder.resolve(): source for path in paths for source in _sources_of(path)}
    methods = Counter(source.scene for source in sources.values())
    found: dict[str, DriveSource] = {}
    for source in sources.values():
        own = source.scene if methods[source.scene] == 1 else source.full_name
        if own in found:
            raise RequestError(
                f"{found[own].folder} and {source.folder} are both the scene {own}: serve one of them, or rename "
                "a folder"
            )
        found[own] = source
    return found


def find_long_drives(sources: Mapping[str, DriveSource]) -> dict[str, LongDriveSource]:
    """The drives that some of the sources are blocks of, by scene id: the name of the drive, or `drive/method` where
    several methods of it are served. Raises ResultError for a damaged blocks.json."""
    found: dict[tuple[Path, str], dict[str, str]] = {}
    for name, source in sources.items():
        folder = source.folder.resolve().parent.parent / drive_of(source.scene)
        if drive_of(source.scene) != source.scene and (folder / BLOCKS).is_file():
            found.setdefault((folder, source.method), {})[source.scene] = name
    methods = Counter(folder for folder, _ in found)
    drives = {}
    for (folder, method), of_blocks in found.items():
        blocks = read_blocks(folder / BLOCKS)
        shown = of_blocks.keys() - blocks_left_out(folder / method)
        own = {number: of_blocks[name] for number, name in enumerate(blocks.names) if name in shown}
        if not own:
            continue
        drives[folder.name if methods[folder] == 1 else f"{folder.name}/{method}"] = LongDriveSource(
            folder, blocks, own
        )
    return drives


def _sources_of(path: Path) -> Iterator[DriveSource]:
    """The trained drives of one argument."""
    if path.is_file():
        yield DriveSource.packed(path)
        return
    trained = [file.parent for depth in ("", "*/", "*/*/") for file in sorted(path.glob(f"{depth}{CHECKPOINT}"))]
    folders = [folder for folder in trained if not (folder.resolve().parent / BLOCKS).is_file()]  # of the drive, uncut
    archives = [] if folders else sorted(path.glob("*.usdz"))
    yield from map(DriveSource.packed, archives)
    if not folders and not archives:
        model_file(path)  # a training that runs; raises RequestError for a folder without any
        folders = [path]
    yield from map(DriveSource.of, folders)


@dataclass(frozen=True, eq=False)
class LoadedDrive:
    """A drive in memory, with the actors that requests can place by their ids."""

    drive: TrainedDrive
    actors: Mapping[str, EditedActor]

    def seconds(self, times: FrameTimes) -> float:
        """The time of the drive that a frame shows, seconds since its first image. Up to MAX_LEAD seconds before the
        first image and after the last one, as the path of the vehicle is known and where its first and last exposures
        begin and end, it is that of this image. Raises ServiceError (OUT_OF_RANGE) for a time farther outside."""
        whole, half = times.shown_us
        time = self.drive.scene.seconds(whole) + 0.5e-6 * half
        if not -MAX_LEAD <= time <= self.drive.duration + MAX_LEAD:
            stamps = self.recorded_us
            raise ServiceError(
                "OUT_OF_RANGE",
                f"{self.drive.where} was recorded from {stamps[0]} to {stamps[1]} us, and the frame is at "
                f"{whole + half / 2:.1f} us",
            )
        return min(max(time, 0.0), self.drive.duration)

    @property
    def recorded_us(self) -> tuple[int, int]:
        """The first and the last microsecond of the recording."""
        scene = self.drive.scene
        stamps = [int(recording.timestamp) for recording in scene.frames or scene.sweeps]
        return min(stamps), max(stamps)


class LoadedDrives:
    """The drives that are in memory, at most `max_loaded`: the one that has been used longest ago makes place. Only one
    thread at a time may call `get`."""

    def __init__(self, offered: Mapping[str, DriveSource], device: str, max_loaded: int):
        """`device` is 'cpu' or 'cuda'."""
        self.offered, self.max_loaded = offered, max_loaded
        self.long_drives = find_long_drives(offered)
        self._device = device
        self._aliases = {source.full_name: name for name, source in offered.items()}
        self._aliases |= {source.archive_id: name for name, source in offered.items() if source.archive_id}
        self._loaded: dict[str, LoadedDrive] = {}  # the one used last is the last

    @property
    def scene_ids(self) -> list[str]:
        """The ids that a simulator may know scenes by: long drives, scenes, and then archives."""
        archives = (source.archive_id for source in self.offered.values() if source.archive_id)
        return [*self.long_drives, *self.offered, *archives]

    def place(self, scene_id: str, times: FrameTimes) -> ScenePlace:
        """The scene that a request is about: of a long drive the block at its time. Raises ServiceError (NOT_FOUND) for
        one that is not served."""
        long_drive = self.long_drives.get(scene_id)
        return ScenePlace(self.name_of(scene_id)) if long_drive is None else long_drive.place(scene_id, times)

    def name_of(self, scene_id: str) -> str:
        """The scene id of a request as it is offered; `scene/method` also names a scene of one method, the id of its
        archive any scene, and the id of a long drive its first block. Raises ServiceError (NOT_FOUND) for a scene that
        is not served."""
        if scene_id in self.long_drives:
            return self.long_drives[scene_id].first
        name = scene_id if scene_id in self.offered else self._aliases.get(scene_id)
        if name is None:
            raise ServiceError(
                "NOT_FOUND",
                f"there is no scene {scene_id[:80]!r}; there are: {', '.join([*self.long_drives, *self.offered])}",
            )
        return name

    @property
    def names(self) -> list[str]:
        """An id of each of the drives in memory, that of its archive where it has one; any thread may ask."""
        loaded = list(self._loaded)  # in one step: another thread may load a drive meanwhile
        return [self.offered[name].archive_id or name for name in loaded]

    def __len__(self) -> int:
        """The number of drives in memory."""
        return len(self._loaded)

    def get(self, scene_id: str) -> LoadedDrive:
        """A drive, which is loaded if it is not in memory. Raises ServiceError for an unknown scene, a result that
        cannot be read, and exhausted memory."""
        name = self.name_of(scene_id)
        if name not in self._loaded:
            while len(self._loaded) >= self.max_loaded:
                self._unload()
            with as_service_errors():
                self._loaded[name] = self._opened(name)
        else:
            self._loaded[name] = self._loaded.pop(name)
        return self._loaded[name]

    def _opened(self, name: str) -> LoadedDrive:
        """Opens a drive; where memory is exhausted, again without any other."""
        source, drive = self.offered[name], None
        try:
            drive = source.open(self._device)
        except DeviceError:
            if not self._loaded:
                raise
        if drive is None:  # here, since an error that is handled keeps what was opened in part
            while self._loaded:
                self._unload()
            drive = source.open(self._device)
        return LoadedDrive(drive, {actor.id: actor for actor in drive.edited_actors})

    def _unload(self) -> None:
        """Drops the drive that has been used longest ago."""
        del self._loaded[next(iter(self._loaded))]
        gc.collect()  # models are parts of reference cycles
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
