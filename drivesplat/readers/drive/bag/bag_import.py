"""Imports a bag as a drive folder: one image or sweep at a time is in memory, beside tables of poses and times.

>>> text, table = propose(Path("monday.mcap"))
>>> import_bag(Path("monday.mcap"), Path("topics.yaml"), Path("drives/monday"), start=10.0, end=40.0).path
PosixPath('drives/monday/drive.json')
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from drivesplat.errors import DatasetError, RequestError
from drivesplat.io.storage import unwritable, write_json
from drivesplat.readers.drive.bag.bag_file import BagFile, listed, open_bag
from drivesplat.readers.drive.bag.bag_map import TF, BagMap, Decision, read_map
from drivesplat.readers.drive.bag.clouds import POINT_CLOUD
from drivesplat.readers.drive.bag.drive_record import DriveOfBag, calibrations_of
from drivesplat.readers.drive.bag.images import CAMERA_INFO, COMPRESSED_IMAGE, RAW_IMAGE
from drivesplat.readers.drive.bag.proposal import proposed_map
from drivesplat.readers.drive.bag.recordings import SensorRecordings, recordings_of, write_recordings
from drivesplat.readers.drive.bag.survey import BagSurvey, clock_fault, survey
from drivesplat.readers.drive.bag.transforms import (
    ODOMETRY,
    TRANSFORMS,
    EgoTrack,
    TransformTree,
    ego_track,
    read_transforms,
)
from drivesplat.readers.drive.conversion import write_checked
from drivesplat.readers.drive.format import FILE
from drivesplat.readers.drive.poses import matrix_of
from drivesplat.readers.drive.write import require_empty

RECORD = "import.json"
"""The file with the decisions of an import, beside drive.json."""
POSES_AROUND = 5_000_000_000
"""Nanoseconds before and after the window in which transforms are read: stamps and log times differ."""
PROPOSAL_SPAN = 10_000_000_000
"""Nanoseconds of transforms that a proposal looks at."""


@dataclass(frozen=True)
class ImportedBag:
    """A finished import: the path of drive.json, the number of files by sensor, and sentences on what was left out."""

    path: Path
    counts: dict[str, int]
    notes: tuple[str, ...]


def propose(path: Path, start: float | None = None, end: float | None = None) -> tuple[str, str]:
    """The text of the map proposed for a bag, and a table of its topics, by the first messages between `start` and
    `end` (seconds after the first message).

    Raises DatasetError where the bag is damaged or there is nothing to import; RequestError where rosbags is missing.
    """
    with open_bag(path) as bag:
        begin, stop = _window(bag, start, end)
        found = survey(bag, begin, stop)
        tree = read_transforms(bag, "header", None, None, begin, min(stop, begin + PROPOSAL_SPAN))
        return proposed_map(found, tree, path.name), found.table()


def import_bag(
    path: Path, map_path: Path, folder: Path, start: float | None = None, end: float | None = None
) -> ImportedBag:
    """Writes the recordings of a bag between `start` and `end` (seconds after its first message) as a drive folder.

    Args:
        path: a .bag, .mcap or .db3 file, or a folder with metadata.yaml or with such files of one recording.
        map_path: the map of topics (`bag_map`).
        folder: a new or empty folder; nothing of it remains where the import fails.

    Raises DatasetError for a bag that is damaged or does not fit the map; ConfigError for a map that is no YAML;
    RequestError where rosbags is missing; ResultError where the folder cannot be written.
    """
    bag_map, decisions = read_map(map_path)
    require_empty(folder)
    with open_bag(path) as bag:
        begin, stop = _window(bag, start, end)
        _require_topics(bag, bag_map, map_path)
        found = survey(bag, begin, stop)
        if bag_map.clock == "header":
            _require_one_clock(found, bag_map)
        odometry = None if bag_map.poses in (None, TF) else bag_map.poses
        around = begin - POSES_AROUND, stop + POSES_AROUND
        tree = read_transforms(bag, bag_map.clock, odometry, bag_map.vehicle, *around)
        ego = _ego(tree, bag_map)
        calibrations, turns = calibrations_of(bag_map, found)
        drive = DriveOfBag(bag_map, tree, ego, calibrations, turns)
        recordings = recordings_of(bag_map, calibrations)
        for topic, name in bag_map.topics.items():
            recordings[name].require_sound(topic, found.topics[topic].samples)
        with _new_folder(folder) as aside:
            by_topic = {topic: recordings[name] for topic, name in bag_map.topics.items()}
            write_recordings(bag, by_topic, (begin, stop), bag_map.clock, ego, aside)
            write_checked(aside / FILE, drive.record(recordings, f"Imported from {path.name}"), folder / FILE)
            whole = start is None and end is None
            indexed = {name: bag.topics[topic].count for topic, name in bag_map.topics.items() if whole}
            notes = drive.notes(recordings, indexed)
            write_json(aside / RECORD, _import_record(path, (start, end), decisions, recordings, notes))
    counts = {name: len(one.files) for name, one in recordings.items()}
    return ImportedBag(folder / FILE, counts, tuple(notes))


def _window(bag: BagFile, start: float | None, end: float | None) -> tuple[int, int]:
    """The log times of a window in nanoseconds. Raises RequestError where it is none or beyond the bag."""
    seconds = (bag.end - bag.begin) * 1e-9
    first, last = 0.0 if start is None else start, math.inf if end is None else end
    if not 0 <= first < last:
        raise RequestError(f"--start {first:g} and --end {last:g} are no window: 0 <= start < end, in seconds")
    if first > seconds:
        raise RequestError(f"--start {first:g} is beyond the bag, which has {seconds:.1f} s")
    return bag.begin + round(first * 1e9), min(bag.end + 1, bag.begin + round(min(last, 1e9) * 1e9))


def _require_topics(bag: BagFile, bag_map: BagMap, map_path: Path) -> None:
    """Raises DatasetError where the map names a topic that the bag does not have, or whose type is another."""
    named = [
        (f"cameras.{name}.images", one.images, (RAW_IMAGE, COMPRESSED_IMAGE)) for name, one in bag_map.cameras.items()
    ]
    named += [(f"cameras.{name}.info", one.info, (CAMERA_INFO,)) for name, one in bag_map.cameras.items() if one.info]
    named += [(f"lidars.{name}.points", one.points, (POINT_CLOUD,)) for name, one in bag_map.lidars.items()]
    named += [] if bag_map.poses in (None, TF) else [("poses", bag_map.poses, (ODOMETRY,))]
    for key, topic, kinds in named:
        if topic not in (known := [one.name for one in bag.of_kind(*kinds)]):
            what = " or ".join(kind.rpartition("/")[2] for kind in kinds)
            raise DatasetError(
                f"{map_path}: {key} is {topic}, on which {bag.path} has no {what}; topics with it: {listed(known)}"
            )
    if bag_map.poses == TF and not bag.of_kind(*TRANSFORMS):
        raise DatasetError(
            f"{bag.path} has no tf, and so no poses of the vehicle; record /tf and /tf_static, name a topic of "
            "Odometry as poses in the map, or set poses: null to have them estimated (docs/poses.md)"
        )


def _require_one_clock(found: BagSurvey, bag_map: BagMap) -> None:
    names = {*bag_map.topics, bag_map.poses}
    used = [
        one for one in found.topics.values() if one.name in names or (bag_map.poses == TF and one.kind in TRANSFORMS)
    ]
    if fault := clock_fault(used):
        raise DatasetError(f"{fault}; set clock: log in the map, or correct the stamps")


def _ego(tree: TransformTree, bag_map: BagMap) -> EgoTrack | None:
    if bag_map.poses is None:
        return None
    return ego_track(tree, bag_map.vehicle, bag_map.world, matrix_of(bag_map.vehicle_to_ego, "vehicle_to_ego"))


def _import_record(
    path: Path,
    window: tuple[float | None, float | None],
    decisions: Sequence[Decision],
    recordings: Mapping[str, SensorRecordings],
    notes: Sequence[str],
) -> dict[str, Any]:
    """The content of import.json."""
    files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    return {
        "format": "drivesplat import",
        "version": 1,
        "bag": path.name,
        "files": {file.name: file.stat().st_size for file in files},
        "window_s": list(window),
        "rosbags": version("rosbags"),
        "decisions": [asdict(decision) for decision in decisions],
        "sensors": {
            name: {
                "written": len(one.files), "without_pose": one.unposed, "damaged": one.damaged,
                "repeated": one.repeated,
            }
            for name, one in recordings.items()
        },
        "notes": list(notes),
    }  # fmt: skip


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder beside `folder`, which takes its place when the context ends without an exception, and is removed
    otherwise. Raises ResultError where it cannot be written."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{folder.name}.", suffix=".partial", dir=folder.parent) as name:
            aside = Path(name) / "drive"
            aside.mkdir()
            yield aside
            if folder.is_dir():
                folder.rmdir()  # it is empty
            aside.rename(folder)
    except OSError as error:
        raise unwritable(folder, error) from error
