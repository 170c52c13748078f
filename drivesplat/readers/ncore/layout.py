"""The location of NCore clips, and their outlines by the metadata of their stores.

A clip lies in one folder: stores NAME.ncore4.zarr.itar or NAME.ncore4-GROUP.zarr.itar (folders without `.itar`), and
mostly a manifest, a JSON file that lists them. `dataroot` is that folder or up to two folders above it. A scene is a
clip: its NAME, the name of its folder where it is alone there, or the beginning of one of them.
"""

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from drivesplat.errors import DatasetError
from drivesplat.io.regular_file import regular_file
from drivesplat.readers.ncore.store_metadata import METADATA, Metadata, store_metadata
from drivesplat.readers.outline import Outline, RecordedCamera
from drivesplat.readers.record_names import text_fault

HOW = "docs/ncore.md says what a clip is; set datasets.<name>.dataroot to the folder of the clip, or to one above"
EXTRA = "pip install 'drivesplat[ncore]'"
VERSION = 4
STORE = re.compile(r"(?P<clip>.+)\.ncore(?P<version>\d+)(-.+)?\.zarr(\.itar)?")
MAX_NAMED = 10
"""Maximum number of clips that a message names."""
MAX_MANIFEST = 200_000_000
"""Maximum number of bytes of a manifest."""


@dataclass(frozen=True)
class ClipFiles:
    """The files of a clip: the paths of its `stores`, folders or files, and its `manifest`, None without one."""

    name: str
    stores: tuple[Path, ...]
    manifest: Path | None


def missing_package() -> str | None:
    """The package that reading clips needs and this Python lacks, with what to do; None if all are installed."""
    for module, package in (("ncore", "nvidia-ncore"), ("zarr", "zarr"), ("cbor2", "cbor2")):
        if find_spec(module) is None:
            return f"{package}, which reads NCore clips, is not installed: {EXTRA}"
    return None


def find_root(dataroot: str, version: str) -> Path:
    """The folder `dataroot`. Raises DatasetError where neither it nor a folder in it holds a clip."""
    root = Path(dataroot).expanduser()
    if not root.is_dir():
        raise DatasetError(f"NCore clips not found: there is no folder {root}; {HOW}")
    if not _clips(root):
        raise DatasetError(f"NCore clips not found: looked for *.ncore4*.zarr.itar in {root} and its folders; {HOW}")
    return root


def clip_files(root: Path, scene: str) -> ClipFiles:
    """The files of a scene's clip.

    Raises DatasetError for a clip that is not there, with those that are, for one of another NCore version, for a
    damaged manifest, and naming the first store that is missing.
    """
    clips = _clips(root)
    found = {name: stores for name, stores in clips.items() if scene in _names(name, stores, clips)}
    found = found or {
        name: stores
        for name, stores in clips.items()
        if any(known.startswith(scene) for known in _names(name, stores, clips))
    }
    if len(found) != 1:
        wrong = "begins the names of several clips" if found else "is not there"
        known = sorted(found or clips)
        more = f" and {len(known) - MAX_NAMED} more" if len(known) > MAX_NAMED else ""
        raise DatasetError(
            f"scene {scene} {wrong}; in {root} there are: {', '.join(known[:MAX_NAMED]) or 'none'}{more}"
        )
    (name, stores), *_ = found.items()
    manifest, listed = _manifest(name, stores)
    _require_version(scene, listed)
    for store in listed:
        if not (store / METADATA).is_file() and not (store.is_file() and store.suffix == ".itar"):
            lacks = f"has no {METADATA}" if store.is_dir() else "is missing"
            raise DatasetError(f"scene {scene}: store {store} {lacks}; copy the whole clip again")
    return ClipFiles(name, tuple(listed), manifest)


def table_files(root: Path, version: str, scene: str) -> list[Path]:
    """The files from which `read` reads a scene: of stores that are folders the file of their metadata. Raises
    DatasetError as `clip_files`."""
    files = clip_files(root, scene)
    stores = [store / METADATA if store.is_dir() else store for store in files.stores]
    return stores if files.manifest is None else [files.manifest, *stores]


def camera_names(root: Path, version: str) -> list[str]:
    """The names of the cameras of all clips that can be read. Raises DatasetError where none can."""
    names: dict[str, None] = {}
    fault: DatasetError | None = None
    for name, stores in _clips(root).items():
        try:
            manifest, listed = _manifest(name, stores)
            names |= dict.fromkeys(
                cameras_in(clip_metadata(listed)) if manifest is None else _manifest_cameras(manifest)
            )
        except DatasetError as error:
            fault = error
    if fault is not None and not names:
        raise fault
    return sorted(names)


def outline(root: Path, version: str, scene: str) -> Outline | None:
    """What a clip holds; None where its metadata cannot be read, for which `read` gives the reason."""
    files = clip_files(root, scene)
    try:
        metadata = clip_metadata(files.stores)
        lidars = {name: known_frames(metadata, "lidars", name) for name in sensors_in(metadata, "lidars")}
        cameras = {
            name: RecordedCamera(*_resolution(metadata, name), len(known_frames(metadata, "cameras", name)))
            for name in cameras_in(metadata)
        }
        key_sensor = key_frame_sensor(metadata)
        frames = known_frames(metadata, *key_sensor) if key_sensor else []
        return Outline(
            cameras=cameras,
            key_frames=[middle(*frame) for frame in frames],
            sweeps=sum(map(len, lidars.values())),
            without_beams=[name for name, found in lidars.items() if found and not _has_rows(metadata, name)],
        )
    except (AttributeError, DatasetError, IndexError, KeyError, OverflowError, TypeError, ValueError):
        return None


def clip_metadata(stores: Sequence[Path]) -> Metadata:
    """The metadata of all stores of a clip. Raises DatasetError as `store_metadata`."""
    files = [store / METADATA if store.is_dir() else store for store in stores]
    return _metadata(tuple(stores), tuple(file.stat().st_mtime_ns if file.is_file() else 0 for file in files))


@lru_cache(maxsize=8)
def _metadata(stores: tuple[Path, ...], _: tuple[int, ...]) -> Metadata:
    """The metadata of stores with modification times."""
    found: Metadata = {}
    for store in stores:
        found |= store_metadata(store)
    return found


def sensors_in(metadata: Metadata, component: str) -> list[str]:
    """The names of the sensors of a component, 'cameras' or 'lidars', in order."""
    names = (key.split("/") for key in metadata if key.startswith(f"{component}/") and key.endswith("/frames/.zattrs"))
    return sorted(name[1] for name in names if len(name) == 4)


def cameras_in(metadata: Metadata) -> list[str]:
    """The names of the cameras, in order."""
    return sensors_in(metadata, "cameras")


def frame_times(metadata: Metadata, component: str, name: str) -> list[tuple[int, int]]:
    """The start and the end of each frame of a sensor in microseconds, in order. Raises DatasetError for others."""
    record = f"{component[:-1]} {name}"
    rows = metadata[f"{component}/{name}/frames/.zattrs"].get("frames_timestamps_us")
    valid = isinstance(rows, list) and all(
        isinstance(row, list) and len(row) == 2 and all(type(time) is int and 0 <= time <= 10**17 for time in row)
        for row in rows
    )
    if not valid or any(start > end for start, end in rows):
        raise DatasetError(
            f"{record}: its frames_timestamps_us must be pairs of whole microseconds, the start and the end of a frame"
        )
    return [(start, end) for start, end in rows]


def known_frames(metadata: Metadata, component: str, name: str) -> list[tuple[int, int]]:
    """The frames of a sensor during which the path of the rig is known."""
    first, last = path_span(metadata)
    return [frame for frame in frame_times(metadata, component, name) if first <= frame[0] and frame[1] <= last]


def path_span(metadata: Metadata) -> tuple[float, float]:
    """The first and the last time of the rig's path in microseconds; infinite where no path is stored directly."""
    for key, content in metadata.items():
        if key.startswith("poses/") and key.endswith("/dynamic_poses/.zattrs"):
            for edge in ("('rig', 'world')", "('world', 'rig')"):
                times = content.get(edge, {}).get("timestamps_us")
                if times:
                    return float(times[0]), float(times[-1])
    return -math.inf, math.inf


def key_frame_sensor(metadata: Metadata) -> tuple[str, str] | None:
    """The component and the name of the sensor whose frames are the key frames: the LiDAR with the most sweeps, without
    LiDAR the first camera with images; None without either."""
    lidars = {name: len(known_frames(metadata, "lidars", name)) for name in sensors_in(metadata, "lidars")}
    if any(lidars.values()):
        return "lidars", max(lidars, key=lambda name: lidars[name])
    return next((("cameras", name) for name in cameras_in(metadata) if known_frames(metadata, "cameras", name)), None)


def middle(start: int, end: int) -> int:
    """The time of a frame that lasts from `start` to `end`, in microseconds."""
    return (start + end) // 2


def _resolution(metadata: Metadata, camera: str) -> tuple[int, int]:
    for key, content in metadata.items():
        if key.startswith("intrinsics/") and key.endswith(f"/cameras/{camera}/.zattrs"):
            width, height = map(int, content["camera_model_parameters"]["resolution"])
            return width, height
    raise KeyError(camera)


def _has_rows(metadata: Metadata, lidar: str) -> bool:
    frames = f"lidars/{lidar}/frames/"
    return any(key.startswith(frames) and key.endswith("/ray_bundle/model_element/.zarray") for key in metadata)


def _clips(root: Path) -> dict[str, list[Path]]:
    """The stores of each clip in `root`, in its folders and in theirs, by the clip's name."""
    found: dict[str, list[Path]] = {}
    for folder in _folders(root):
        for path in sorted(folder.glob("*.zarr*")):
            if match := STORE.fullmatch(path.name):
                found.setdefault(match["clip"], []).append(path)
    return dict(sorted(found.items()))


def _folders(root: Path) -> Iterator[Path]:
    """A folder, its folders and theirs, without those that are stores."""
    yield root
    for pattern in ("*/", "*/*/"):
        yield from (folder for folder in sorted(root.glob(pattern)) if ".zarr" not in folder.name + folder.parent.name)


def _names(name: str, stores: Sequence[Path], clips: dict[str, list[Path]]) -> list[str]:
    """The names by which a clip is known: its own, and that of its folder where it is alone there."""
    folder = stores[0].parent
    alone = sum(other[0].parent == folder for other in clips.values()) == 1
    return [name, folder.name] if alone else [name]


def _require_version(scene: str, stores: Sequence[Path]) -> None:
    for store in stores:
        match = STORE.fullmatch(store.name)
        if match and int(match["version"]) != VERSION:
            raise DatasetError(
                f"scene {scene}: {store.name} is a store of NCore V{match['version']}, and V{VERSION} is read; convert "
                "the clip with NCore's tools"
            )


def _manifest(name: str, stores: Sequence[Path]) -> tuple[Path | None, list[Path]]:
    """The manifest of a clip and the stores that it lists; None and all of its stores where there is no manifest.
    Raises DatasetError naming a manifest that is damaged or of another version."""
    folder = stores[0].parent
    known = {store.name for store in stores}
    candidates = [folder / f"{name}.json", *(file for file in sorted(folder.glob("*.json")) if file.stem != name)]
    for file in candidates:
        if file.is_file():
            content = _content(file, file.stat().st_mtime_ns)
            listed = content.get("component_stores") if isinstance(content, dict) else None
            if content is None and file.stem == name:
                raise DatasetError(f"{file} is not JSON; copy the clip again")
            if listed is None:
                continue
            entries = listed if isinstance(listed, list) else []
            paths = [entry.get("path") if isinstance(entry, dict) else None for entry in entries]
            if not paths or not all(text_fault(path) is None and re.fullmatch(r"[^/\\\0]+", path) for path in paths):
                raise DatasetError(f"{file}: its component_stores must be stores beside it, each with its path")
            if file.stem == name or known & set(paths):
                if content.get("version") != f"v{VERSION}":
                    raise DatasetError(
                        f"{file} is a clip of NCore version {str(content.get('version'))[:20]!r}, and v{VERSION} is "
                        "read; convert it with NCore's tools"
                    )
                return file, [folder / path for path in dict.fromkeys(paths)]
    return None, list(stores)


@lru_cache(maxsize=256)
def _content(file: Path, _: int) -> Any:
    """The content of a JSON file with a modification time; None where it is none."""
    try:
        return json.loads(regular_file(file, MAX_MANIFEST).read_text(encoding="utf-8"))
    except (OSError, RecursionError, ValueError):
        return None


def _manifest_cameras(manifest: Path) -> list[str]:
    names: list[str] = []
    for store in _content(manifest, manifest.stat().st_mtime_ns)["component_stores"]:
        components = store.get("components")
        cameras = components.get("cameras") if isinstance(components, dict) else None
        names += cameras if isinstance(cameras, dict) else ()
    return names
