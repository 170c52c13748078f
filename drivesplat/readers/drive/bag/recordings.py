"""The recordings of each sensor of a bag: converted and written one by one, counted, and looked through for gaps."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.io.prefetch import prefetch
from drivesplat.readers.drive.bag.bag_file import BagFile, BagMessage, header_stamp, microseconds
from drivesplat.readers.drive.bag.bag_map import BagCamera, BagMap, Calibration
from drivesplat.readers.drive.bag.clouds import sweep_columns
from drivesplat.readers.drive.bag.images import EncodedImage, image_file
from drivesplat.readers.drive.bag.transforms import EgoTrack
from drivesplat.readers.record_names import counted

SHARE_AFTER_STAMP = {"start": 0.5, "middle": 0.0, "end": -0.5}
"""The part of an exposure from its stamp to its middle."""
GAP_INTERVALS, MIN_GAP_US = 3.0, 250_000
"""Usual intervals and microseconds from which on a time without recordings is a gap."""


@dataclass(frozen=True, eq=False)
class WrittenFile:
    """The file of a message, or the end of a sentence on why there is none."""

    recordings: "SensorRecordings"
    timestamp: int
    name: str = ""
    grey: bool = False
    fault: str = ""


@dataclass(eq=False)
class SensorRecordings:
    """What becomes of the messages of a sensor. `convert` makes a file's content of a message, `shift` is the time in
    microseconds from the stamp to the timestamp; `files` are the written ones by timestamp."""

    name: str
    what: str
    folder: str
    shift: int
    convert: Callable[[Any], EncodedImage | dict[str, np.ndarray]]
    files: dict[int, str] = field(default_factory=dict)
    unposed: int = 0
    repeated: int = 0
    damaged: int = 0
    damage: str = ""
    grey: int = 0
    seen: set[int] = field(default_factory=set)

    @property
    def count(self) -> int:
        """The number of messages."""
        return len(self.files) + self.unposed + self.repeated + self.damaged

    def accepted(self, message: BagMessage, clock: str, ego: EgoTrack | None) -> tuple[int, Any] | None:
        """The timestamp and the content of a message; None, and counted, where it is damaged, has the timestamp of
        another one, or no pose of the vehicle."""
        try:
            content = message.content()
            timestamp = microseconds(header_stamp(content) if clock == "header" else message.log) + self.shift
            if timestamp < 0:
                raise DatasetError(f"has the timestamp {timestamp}")
        except DatasetError as error:
            self._count_damage(str(error))
            return None
        if timestamp in self.seen:
            self.repeated += 1
        elif ego is not None and not ego.covers(timestamp):
            self.unposed += 1
        else:
            self.seen.add(timestamp)
            return timestamp, content
        return None

    def written(self, timestamp: int, content: Any, root: Path) -> WrittenFile:
        """Writes the file of an accepted message below `root`. May run in a thread."""
        try:
            file = self.convert(content)
        except DatasetError as error:
            return WrittenFile(self, timestamp, fault=str(error))
        if isinstance(file, EncodedImage):
            name = f"{self.folder}/{timestamp}{file.suffix}"
            (root / name).write_bytes(file.data)
            return WrittenFile(self, timestamp, name, file.grey)
        name = f"{self.folder}/{timestamp}.npz"
        np.savez(root / name, **file)  # deflating takes longer than all else
        return WrittenFile(self, timestamp, name)

    def add(self, file: WrittenFile) -> None:
        if file.fault:
            self._count_damage(file.fault)
        else:
            self.files[file.timestamp] = file.name
            self.grey += file.grey

    def _count_damage(self, reason: str) -> None:
        self.damaged += 1
        self.damage = self.damage or reason

    def require_sound(self, topic: str, samples: Sequence[Any]) -> None:
        """Raises DatasetError where there are no first messages, or none of them can be converted."""
        if not samples:
            raise DatasetError(f"{self.name}: no {self.what} on {topic} can be read between --start and --end")
        faults = []
        for sample in samples:
            try:
                self.convert(sample)
                return
            except DatasetError as error:
                faults.append(str(error))
        raise DatasetError(f"{self.name}: the first {self.what} on {topic} {faults[0]}")

    def notes(self, begin: int, indexed: int | None) -> list[str]:
        """Sentences on what was left out and is missing. `begin` is the first timestamp of the drive, `indexed` the
        number of messages by the index of the bag, None where not all of it was read."""
        found = []
        if indexed is not None and self.count < indexed:
            found.append(
                f"{self.name}: the index of the bag counts {indexed} messages, {self.count} are there: the bag is "
                "damaged"
            )
        if self.damaged:
            what = counted(self.damaged, self.what)
            found.append(f"{self.name}: {what} of {self.count} left out as damaged; the first one {self.damage}")
        if self.repeated:
            found.append(f"{self.name}: {counted(self.repeated, self.what)} left out with the timestamp of another one")
        if len(self.files) > 2:
            stamps = np.sort(np.fromiter(self.files, dtype=np.int64))
            steps = np.diff(stamps)
            gaps = np.flatnonzero(steps > max(MIN_GAP_US, GAP_INTERVALS * float(np.median(steps))))
            if len(gaps):
                longest = gaps[np.argmax(steps[gaps])]
                at = (stamps[longest] - begin) * 1e-6
                found.append(
                    f"{self.name}: {counted(len(gaps), 'gap')} without a {self.what}, the longest of "
                    f"{steps[longest] * 1e-6:.1f} s from {at:.1f} s on"
                )
        return found


def recordings_of(bag_map: BagMap, calibrations: dict[str, Calibration]) -> dict[str, SensorRecordings]:
    """The recordings of each sensor of a map by its name, cameras first."""
    found = {}
    for name, camera in bag_map.cameras.items():
        shift = round(SHARE_AFTER_STAMP[camera.stamp] * camera.exposure_s * 1e6)
        convert = _camera_converter(calibrations[name], bag_map.raw_images, camera)
        found[name] = SensorRecordings(name, "image", f"images/{name}", shift, convert)
    for name, lidar in bag_map.lidars.items():
        found[name] = SensorRecordings(name, "sweep", f"sweeps/{name}", 0, partial(sweep_columns, lidar=lidar))
    return found


def _camera_converter(calibration: Calibration, raw: str, camera: BagCamera) -> Callable[[Any], EncodedImage]:
    size = (calibration.width, calibration.height)
    source = f"its CameraInfo on {camera.info}" if camera.calibration is None else "the calibration in the map"

    def convert(message: Any) -> EncodedImage:
        file = image_file(message, raw)
        if file.size != size:
            raise DatasetError(
                f"is {file.size[0]}x{file.size[1]}, but {source} is of images of {size[0]}x{size[1]}; state a "
                "calibration of this size in the map"
            )
        return file

    return convert


def unposed_sentence(recordings: Sequence[SensorRecordings]) -> str | None:
    """What was left out for lack of poses, in one sentence; None without any."""
    parts = [f"{one.unposed} of {counted(one.count, one.what)} of {one.name}" for one in recordings if one.unposed]
    if not parts:
        return None
    return (
        f"left out, because the vehicle has no pose within 0.1 s before the first or after the last one, or poses are "
        f"more than 1 s apart: {', '.join(parts)}"
    )


def grey_sentence(recordings: Sequence[SensorRecordings]) -> str | None:
    """A sentence where some cameras record grey images and others colours; otherwise None."""
    cameras = [one for one in recordings if one.what == "image" and one.files]
    grey = [one.name for one in cameras if 2 * one.grey > len(one.files)]
    if not grey or len(grey) == len(cameras):
        return None
    one = len(grey) == 1
    return (
        f"{', '.join(grey)} record{'s' if one else ''} grey images, the other cameras colours: leave "
        f"{'it' if one else 'them'} out of `cameras` in the config, since a model learns one colour for all cameras"
    )


def write_recordings(
    bag: BagFile, by_topic: Mapping[str, SensorRecordings], window: tuple[int, int], clock: str, ego: EgoTrack | None,
    root: Path,
) -> None:  # fmt: skip
    """Writes the files of all messages with log times in a window (nanoseconds) below `root`. Two threads convert and
    write; at most as many messages are in memory beside one that is read."""

    def accepted() -> Iterator[tuple[SensorRecordings, int, Any]]:
        for message in bag.messages(list(by_topic), *window):
            one = by_topic[message.topic]
            if task := one.accepted(message, clock, ego):
                yield one, *task

    for one in by_topic.values():
        (root / one.folder).mkdir(parents=True)
    for file in prefetch(lambda task: task[0].written(*task[1:], root), accepted(), threads=2):
        file.recordings.add(file)
