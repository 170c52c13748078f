"""Reads nuScenes tables into a `Scene` with nuscenes-devkit, and checks every value.

nuScenes fires its cameras and its LiDAR at different times: every image and sweep has the ego pose of its own record,
not that of the key frame. The tables' quaternions are w, x, y, z; box sizes are width, length, height.
"""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import (
    MAX_MOUNT,
    checked_beams,
    checked_box_size,
    checked_intrinsics,
    checked_path,
    checked_pose,
    checked_readout,
    checked_size,
    checked_spin,
    require_increasing,
)
from drivesplat.readers.drive_checks import chain, require_microseconds
from drivesplat.readers.nuscenes.layout import missing_package
from drivesplat.readers.nuscenes.object_classes import object_class
from drivesplat.readers.nuscenes.row_checks import check_rows
from drivesplat.readers.nuscenes.scene_tables import PREFIX, damaged, read_scene_tables, scene_file, write_scene_tables
from drivesplat.readers.outline import frames_beyond
from drivesplat.readers.record_names import named
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame, Scene, Sweep, Track
from drivesplat.scene.sensors import Camera, Lidar, Spin
from drivesplat.settings.extract import SceneSource

READER = "nuscenes"
KEY_FRAME_HZ = 2.0
"""The rate of a drive with one key frame."""
LIDAR = "LIDAR_TOP"
BEAM_ELEVATIONS = np.radians(np.linspace(-30.67, 10.67, 32))
AZIMUTH_STEPS = 1085
"""Of the Velodyne HDL-32E at 20 Hz (user's manual): 32 beams in ring order, lowest first, which fire every 46.08
microseconds. The number of firings per revolution varies by one or two."""
SPIN = Spin(0.05, -0.05, np.pi)
"""From the left, clockwise; the timestamp is that of the end (https://forum.nuscenes.org/t/245)."""


def read(root: Path, source: SceneSource, scene_tables: Path | None = None) -> Scene:
    """The scene of `source`, without the dataset's name. `root` contains the folder of tables, `scene_tables` is the
    file of the scene's rows (None: they are extracted from the tables).

    `source.sweeps` adds the images between key frames, `source.lidar_sweeps` the LiDAR sweeps. `source.frames` =
    (first, last + 1) keeps these key frames, renumbered from 0, and the recordings between them. Image files are
    not opened. Raises DatasetError naming the offending token.
    """
    version, name, cameras, frames = source.version, source.scene, source.cameras, source.frames
    tables = _load(root, source, scene_tables)
    record = tables.scene[0]
    tokens = chain(record["first_sample_token"], lambda token: _get(tables, "sample", token)["next"], "sample")
    samples = [_get(tables, "sample", token) for token in tokens]
    require_microseconds([s["timestamp"] for s in samples], f"scene {name}")
    if fault := frames_beyond(name, len(samples), frames):
        raise DatasetError(fault)
    samples = samples[slice(*(frames or (None, None)))]
    times = require_increasing([s["timestamp"] for s in samples], [s["token"] for s in samples], "sample")
    hz = 1e6 / float(np.median(np.diff(times))) if len(times) > 1 else KEY_FRAME_HZ
    channel = LIDAR if LIDAR in samples[0]["data"] or not cameras else cameras[0]
    origin = _ego_pose(tables, _key_data(tables, samples[0], channel))[:3, 3].copy()
    scene = Scene(
        name=name,
        dataset="",
        version=version,
        description=record.get("description") or "",
        origin=origin,
        key_frame_timestamps=times,
        frames=(),
        sweeps=(),
        tracks=(),
        poses=READER,
        key_frame_hz=float(round(hz)) or hz,  # nuScenes' is 2 Hz within a tenth; synthetic worlds have others
        key_frame_range=list(frames) if frames else None,
    )
    images = [f for camera in cameras for f in _frames(tables, root, samples, camera, source.sweeps, scene)]
    sweeps = []
    if any(LIDAR in sample["data"] for sample in samples):
        for data, index, _, sensor_to_world, _ in _recordings(tables, samples, LIDAR, source.lidar_sweeps, scene):
            path = str(root / checked_path(data.get("filename"), named("sample_data", data["token"])))
            time, is_key_frame = data["timestamp"], data["is_key_frame"]
            sweeps.append(Sweep(path, time, sensor_to_world, is_key_frame, index, data["token"], LIDAR, READER))
    return dataclasses.replace(
        scene,
        frames=tuple(images),
        sweeps=tuple(sweeps),
        tracks=tuple(_tracks(tables, samples, origin)),
        cameras=tuple({frame.camera: _camera(tables, frame) for frame in images}.values()),
        lidars=(_lidar(tables, sweeps[0], version),) if sweeps else (),
    )


def _camera(tables: Any, frame: Frame) -> Camera:
    """The camera of a frame. nuScenes' images are rectified; only synthetic worlds state readout times."""
    sensor = _calibration(tables, frame.token)
    record = named("calibrated_sensor", sensor["token"])
    seconds, direction = checked_readout(sensor.get("readout_s"), sensor.get("readout_direction"), record)
    return Camera(
        frame.camera, frame.width, frame.height, frame.intrinsics, distortion=np.zeros(5), readout_s=seconds,
        readout_direction=direction,
    )  # fmt: skip


def _lidar(tables: Any, sweep: Sweep, version: str) -> Lidar:
    """The LiDAR of a sweep: nuScenes' own, unless the tables have another version than nuScenes', or a synthetic world
    states its beams and, where it spins, its spin."""
    sensor = _calibration(tables, sweep.token)
    record = named("calibrated_sensor", sensor["token"])
    known = (BEAM_ELEVATIONS, AZIMUTH_STEPS, SPIN) if version.startswith("v1.0-") else (None, None, None)
    elevations, steps = sensor.get("beam_elevations", known[0]), sensor.get("azimuth_steps", known[1])
    beams, spin = checked_beams(elevations, steps, record), known[2]
    if "beam_elevations" in sensor:
        spin = checked_spin(sensor["spin"], record) if "spin" in sensor else None
    return Lidar(LIDAR, *beams, spin)


def _calibration(tables: Any, sample_data: str) -> dict:
    return _get(tables, "calibrated_sensor", _get(tables, "sample_data", sample_data)["calibrated_sensor_token"])


def _load(root: Path, source: SceneSource, scene_tables: Path | None) -> Any:
    """nuscenes-devkit's view of the tables, reduced to one scene."""
    if missing := missing_package():
        raise DatasetError(missing)
    from nuscenes.nuscenes import NuScenes

    with TemporaryDirectory() as folder:
        if scene_tables is None:
            write_scene_tables(root, source.version, [source.scene], Path(folder))
            scene_tables = scene_file(Path(folder), source.scene)
        tables = read_scene_tables(scene_tables)
        names = [row["name"] for row in tables["scene"]]
        if not {source.scene, f"{PREFIX}{source.scene}"}.intersection(names):
            available = ", ".join(name.removeprefix(PREFIX) for name in names)
            raise DatasetError(
                f"scene {source.scene} is not in nuScenes {source.version} at {root}; there are: {available}"
            )
        check_rows(tables)
        try:
            (Path(folder) / source.version).mkdir()
            for row in tables["map"]:
                row["filename"] = folder  # maps are not read, and nuscenes-devkit asks for any path that exists
            for table, rows in tables.items():
                (Path(folder) / source.version / f"{table}.json").write_text(json.dumps(rows), encoding="utf-8")
            return NuScenes(source.version, folder, verbose=False)
        except (AssertionError, RecursionError, ValueError, OSError) as error:
            raise damaged(root, source.version, error) from error


def _get(tables: Any, table: str, token: str) -> dict:
    try:
        return tables.get(table, token)
    except KeyError:
        raise DatasetError(f"{table} {token} is referred to but not in the tables") from None


def _ego_pose(tables: Any, data: dict) -> np.ndarray:
    pose = _get(tables, "ego_pose", data["ego_pose_token"])
    return checked_pose(pose.get("translation"), pose.get("rotation"), named("ego_pose", pose["token"]))


def _key_data(tables: Any, sample: dict, channel: str) -> dict:
    if channel not in sample["data"]:
        raise DatasetError(
            f"sample {sample['token']} has no {channel}; it has {', '.join(sorted(sample['data'])) or 'nothing'}"
        )
    return _get(tables, "sample_data", sample["data"][channel])


def _records(tables: Any, samples: list[dict], channel: str, sweeps: bool) -> Iterator[dict]:
    """The sample_data of a channel in time order: key frames, and with `sweeps` the records between them."""
    key = [_key_data(tables, sample, channel) for sample in samples]
    require_increasing([d["timestamp"] for d in key], [d["token"] for d in key], "sample_data")
    if not sweeps:
        yield from key
        return
    key_tokens, data = {d["token"] for d in key}, key[0]
    while True:
        if data["channel"] != channel or data["is_key_frame"] != (data["token"] in key_tokens):
            raise DatasetError(
                f"{named('sample_data', data['token'])}: it stands in the chain of another sensor or scene"
            )
        key_tokens.discard(data["token"])
        yield data
        if data["token"] == key[-1]["token"]:
            break
        if not data["next"]:
            raise DatasetError(f"sample_data {data['token']}: the chain of {channel} ends before the scene does")
        following = _get(tables, "sample_data", data["next"])
        require_increasing(
            [data["timestamp"], following["timestamp"]], [data["token"], following["token"]], "sample_data"
        )
        data = following
    if key_tokens:
        raise DatasetError(f"{named('sample_data', min(key_tokens))}: the chain of {channel} leaves it out")


def _recordings(
    tables: Any, samples: list[dict], channel: str, sweeps: bool, scene: Scene
) -> Iterator[tuple[dict, int, np.ndarray, np.ndarray, dict]]:
    """The records of a channel, each with its key frame, its ego and sensor poses in world coordinates, and its
    calibration."""
    index_of_sample = {sample["token"]: i for i, sample in enumerate(samples)}
    for data in _records(tables, samples, channel, sweeps):
        at, of_sample = data["timestamp"], data["sample_token"]
        index = index_of_sample[of_sample] if data["is_key_frame"] else scene.nearest_key_frame(at)
        apart = abs(at - int(scene.key_frame_timestamps[index]))
        if data["is_key_frame"] and apart > max(1e6, scene.key_frame_interval):
            raise DatasetError(
                f"{named('sample_data', data['token'])}: its timestamp is {apart * 1e-6:g} s from that of its sample; "
                "both must be microseconds of one clock"
            )
        sensor = _get(tables, "calibrated_sensor", data["calibrated_sensor_token"])
        ego_to_world = _ego_pose(tables, data)
        ego_to_world[:3, 3] -= scene.origin
        mount, turn = sensor.get("translation"), sensor.get("rotation")
        sensor_to_ego = checked_pose(mount, turn, named("calibrated_sensor", sensor["token"]), MAX_MOUNT)
        yield data, index, ego_to_world, ego_to_world @ sensor_to_ego, sensor


def _frames(tables: Any, root: Path, samples: list[dict], camera: str, sweeps: bool, scene: Scene) -> Iterator[Frame]:
    for data, index, ego_to_world, camera_to_world, sensor in _recordings(tables, samples, camera, sweeps, scene):
        record, calibration = named("sample_data", data["token"]), named("calibrated_sensor", sensor["token"])
        width, height = checked_size(data.get("width"), data.get("height"), record)
        yield Frame(
            camera=camera,
            timestamp=data["timestamp"],
            image_path=str(root / checked_path(data.get("filename"), record)),
            width=width,
            height=height,
            intrinsics=checked_intrinsics(sensor.get("camera_intrinsic"), calibration, (width, height)),
            camera_to_world=camera_to_world,
            ego_to_world=ego_to_world,
            is_key_frame=data["is_key_frame"],
            sample_index=index,
            token=data["token"],
        )


def _tracks(tables: Any, samples: list[dict], origin: np.ndarray) -> Iterator[Track]:
    """One track per instance, its annotations in time order."""
    by_instance: dict[str, list[tuple[int, int, dict]]] = {}
    for i, sample in enumerate(samples):
        for token in sample["anns"]:
            annotation = _get(tables, "sample_annotation", token)
            by_instance.setdefault(annotation["instance_token"], []).append((i, sample["timestamp"], annotation))
    for instance, entries in by_instance.items():
        annotations = [annotation for _, _, annotation in entries]
        names = [f"{named('sample_annotation', a['token'])} (instance {instance})" for a in annotations]
        checked = list(zip(annotations, names, strict=True))
        width, length, height = np.median([checked_box_size(a.get("size"), name) for a, name in checked], axis=0)
        levels = [annotation.get("visibility_token", "") for annotation in annotations]
        poses = [checked_pose(a.get("translation"), a.get("rotation"), name) for a, name in checked]
        yield Track(
            id=instance,
            object_class=object_class(annotations[0]["category_name"]),
            category=annotations[0]["category_name"],
            size=np.array([length, width, height]),
            timestamps=np.array([time for _, time, _ in entries], dtype=np.int64),
            sample_indices=np.array([i for i, _, _ in entries], dtype=np.int64),
            object_to_world=np.stack([rigid(pose[:3, :3], pose[:3, 3] - origin) for pose in poses]),
            visibility=np.array([int(v) if v in ("1", "2", "3", "4") else 0 for v in levels], dtype=np.int64),
        )
