"""The location of the files of the Waymo Open Dataset.

v2: a folder for each component, with a file for each segment: camera_image/{segment}.parquet. v1: a file for each
segment, segment-{segment}_with_camera_labels.tfrecord, or {segment}.tfrecord. A scene is a segment: its context name,
or the beginning of it where no other segment begins so.
"""

from dataclasses import dataclass
from pathlib import Path

from drivesplat.errors import DatasetError
from drivesplat.readers.waymo.names import CAMERAS, COMPONENTS, FRAMES, SEGMENTATION, V1, V2

HOW = "docs/waymo.md says what to download; set datasets.<name>.dataroot to the folder that holds it"
PREFIX, SUFFIX = "segment-", "_with_camera_labels"
MAX_NAMED = 10
"""Maximum number of segments that a message names."""


@dataclass(frozen=True)
class SegmentFiles:
    """The files of a segment: `name` is its context name, `version` v1 or v2, `files` by component (v1: FRAMES)."""

    name: str
    version: str
    files: dict[str, Path]


def find_root(dataroot: str, version: str) -> Path:
    """The folder `dataroot`. Raises DatasetError where it holds no segments."""
    root = Path(dataroot).expanduser()
    if not root.is_dir():
        raise DatasetError(f"Waymo dataset not found: there is no folder {root}; {HOW}")
    if not _segments(root, V1) and not _segments(root, V2):
        raise DatasetError(
            f"Waymo dataset not found: looked for *.tfrecord and {COMPONENTS[0]}/*.parquet in {root}; {HOW}"
        )
    return root


def table_files(root: Path, version: str, scene: str) -> list[Path]:
    """The files from which `read` reads a scene. Raises DatasetError as `segment_files`."""
    return list(segment_files(root, version, scene).files.values())


def camera_names(root: Path, version: str) -> list[str]:
    """The names of the five cameras."""
    return list(CAMERAS.values())


def segment_files(root: Path, version: str, scene: str) -> SegmentFiles:
    """The files of a scene. `version` selects v1 or v2; with any other text the one that is there is taken.

    Raises DatasetError for a segment that is not there, with those that are, for one that is there in both versions,
    and for one that lacks a component, or whose name is not that of a file.
    """
    versions = [version] if version in (V1, V2) else [V1, V2]
    segments = {name: _segments(root, name) for name in versions}
    known = sorted({segment for found in segments.values() for segment in found})
    found = [scene] if scene in known else [name for name in known if name.startswith(scene)]
    if len(found) != 1:
        wrong = "begins the names of several segments" if found else "is not there"
        shown = ", ".join((found or known)[:MAX_NAMED])
        more = len(found or known) - MAX_NAMED
        raise DatasetError(
            f"scene {scene} {wrong}; in {root} there are: {shown or 'none'}{f' and {more} more' if more > 0 else ''}"
        )
    name = found[0]
    holding = [version for version in versions if name in segments[version]]
    if len(holding) > 1:
        raise DatasetError(
            f"scene {scene} is in {root} as v1 ({segments[V1][name].name}) and as v2; "
            "set datasets.<name>.version to v1 or v2"
        )
    if holding == [V1] and not segments[V1][name].is_file():
        raise DatasetError(f"scene {scene}: {segments[V1][name]} is not a file; download the segment again")
    if holding == [V1]:
        return SegmentFiles(name, V1, {FRAMES: segments[V1][name]})
    files = {component: root / component / f"{name}.parquet" for component in COMPONENTS}
    absent = [component for component, file in files.items() if not file.is_file()]
    if absent:
        raise DatasetError(
            f"scene {scene}: {', '.join(f'{component}/{name}.parquet' for component in absent)} "
            f"{'is' if len(absent) == 1 else 'are'} missing in {root}; docs/waymo.md lists the components that are read"
        )
    segmentation = root / SEGMENTATION / f"{name}.parquet"
    return SegmentFiles(name, V2, files | ({SEGMENTATION: segmentation} if segmentation.is_file() else {}))


def _segments(root: Path, version: str) -> dict[str, Path]:
    """A file of each segment of a version by the segment's name."""
    if version == V2:
        return {file.stem: file for component in COMPONENTS for file in root.glob(f"{component}/*.parquet")}
    return {file.stem.removeprefix(PREFIX).removesuffix(SUFFIX): file for file in root.glob("*.tfrecord")}
