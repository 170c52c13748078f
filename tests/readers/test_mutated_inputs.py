"""Damaged inputs: a drive of nuScenes or Waymo is read as a sound scene or refused in one line, in time."""

import math
import shutil
import struct
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers import drives
from helpers.drives import uncompared
from helpers.mutations import (
    Rows,
    damages,
    delete_a_column,
    delete_a_row,
    exchange,
    flip_bytes,
    fresh,
    likely,
    mutate_bytes,
    mutate_table,
    repeat_a_row,
    resize_a_list,
    scale_a_column,
)  # fmt: skip
from helpers.table_files import VERSION, copy_of, extracted, time_limit
from helpers.waymo_drive import NAME, Drive, tiny_drive
from helpers.waymo_files import components, frame_message, tfrecord, write_v1, write_v2

from drivesplat.errors import DatasetError
from drivesplat.preprocess.extract import extract_scene
from drivesplat.readers.nuscenes.layout import TABLES
from drivesplat.readers.sweeps import read_returns, sweep_fault
from drivesplat.readers.waymo.names import COMPONENTS
from drivesplat.scene.scene import Scene, read_scene, write_scene
from drivesplat.scene.sensors import LidarReturns

USED = [table for table in TABLES if table not in ("attribute", "visibility")]
LARGE = ["sample", "sample_data", "ego_pose", "calibrated_sensor", "sample_annotation"]


@pytest.fixture(scope="module")
def small_scene(small_root) -> Scene:
    return extracted(small_root, sweeps=False)


def one_line(error: DatasetError, done: object) -> None:
    """A refusal is one line that says something, and does not blame the results."""
    message = str(error)
    assert "\n" not in message and 10 < len(message) < 1000 and message.isprintable(), done


def require_sound(scene: Scene, root: Path, folder: Path) -> None:
    """What the checks of readers promise, computed in other ways than they do."""
    times = scene.key_frame_timestamps
    assert len(times) and (np.diff(times) > 0).all() and times[0] >= 0 and times[-1] <= 1e17
    assert len(times) < 2 or np.median(np.diff(times)) >= 1000
    poses = [pose for frame in scene.frames for pose in (frame.camera_to_world, frame.ego_to_world)]
    poses += [sweep.sensor_to_world for sweep in scene.sweeps]
    poses += [pose for track in scene.tracks for pose in track.object_to_world]
    assert np.isfinite(poses).all() and np.abs(poses).max() <= 3e8
    turns = np.array(poses)[:, :3, :3]
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-6)
    np.testing.assert_allclose(turns @ np.swapaxes(turns, 1, 2), np.eye(3)[None].repeat(len(turns), 0), atol=1e-6)
    assert len({f.token for f in scene.frames}) == len(scene.frames) > 0
    for frame in scene.frames:
        fx, fy, cx, cy = frame.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        assert 0 <= cx <= frame.width and 0 <= cy <= frame.height
        assert all(0.1 * frame.width <= focal <= 20 * frame.width for focal in (fx, fy))
        assert root in Path(frame.image_path).parents and ".." not in Path(frame.image_path).parts
    for track in scene.tracks:
        assert ((track.size > 0) & (track.size <= 1000)).all() and (np.diff(track.timestamps) > 0).all()
        assert len(set(track.sample_indices.tolist())) == len(track.timestamps)
    write_scene(folder / "scene.json", scene)
    assert repr(read_scene(folder / "scene.json").tracks) == repr(scene.tracks)


def require_ordered(scene: Scene) -> None:
    """Recordings in order, with one of each sensor at each key frame."""
    for records in (scene.frames, scene.sweeps):
        assert all(b.timestamp > a.timestamp for a, b in pairwise(records))
        assert all(type(it.is_key_frame) is bool and type(it.timestamp) is int for it in records)
        key_frames = [it.sample_index for it in records if it.is_key_frame]
        assert key_frames == list(range(len(scene.key_frame_timestamps))) or not records or scene.missing_images


@damages(20, 140)
def test_damaged_tables_are_refused_in_one_line_or_give_a_sound_scene(small_root, tmp_path, random):
    with fresh(tmp_path) as folder:
        root = copy_of(small_root, folder / "data")
        done = [mutate_table(random, root / VERSION / f"{random.choice(USED + 2 * LARGE)}.json")]
        try:
            with uncompared(unless=likely(random, 3)):
                scene = extracted(root, on_missing=random.choice(["stop", "warn"]))
        except DatasetError as error:
            one_line(error, done)
        else:
            require_ordered(scene)
            require_sound(scene, root, folder)


@damages(5, 15)
def test_damaged_images_are_refused_in_one_line_or_read(small_root, tmp_path, random):
    with fresh(tmp_path) as folder:
        root = Path(shutil.copytree(small_root, folder / "data"))
        done = mutate_bytes(random, random.choice(sorted(root.glob("s*/CAM_FRONT/*"))))
        try:
            require_sound(extracted(root), root, folder)
        except DatasetError as error:
            one_line(error, done)
            assert "image" in str(error), done


def require_near(returns: LidarReturns, done: object) -> None:
    assert len(returns.points) and np.linalg.norm(returns.points, axis=1).max() < 2000.0, done
    assert np.isfinite(returns.intensity).all() and (returns.rings >= -1).all(), done


@damages(10, 20)
def test_damaged_sweeps_are_refused_in_one_line_or_have_returns_near_the_sensor(small_scene, tmp_path, random):
    with fresh(tmp_path) as folder:
        sweep = small_scene.sweeps[random.randrange(len(small_scene.sweeps))]
        sweep = replace(sweep, path=shutil.copy(sweep.path, folder))
        done = mutate_bytes(random, Path(sweep.path))
        try:
            with time_limit():
                returns = read_returns(sweep)
        except DatasetError as error:
            one_line(error, done)
            assert sweep.path in str(error)
        else:
            require_near(returns, done)


# Waymo

V1_FILE = f"segment-{NAME}_with_camera_labels.tfrecord"
NUMBERS = [0.0, -1.0, 1e-30, 1e9, 1e30, 1e300, math.nan, math.inf, -math.inf]


@pytest.fixture(scope="module")
def drive(small_root) -> Drive:
    whole = tiny_drive(small_root, drives.SMALL, lasers=(1, 2))[0]
    return replace(whole, images=[image for image in whole.images if image.camera == 1])


@pytest.fixture(scope="module")
def roots(drive, tmp_path_factory) -> dict[str, Path]:
    writers = {"v2": write_v2, "v1": write_v1}
    return {version: write(tmp_path_factory.mktemp(version), drive) for version, write in writers.items()}


def require_sound_or_one_line(root: Path, folder: Path, random: Random, done: object) -> bool:
    """Reads a drive and its sweeps; whether it was refused."""
    source = drives.source(
        dataset="mine", reader="waymo", version="", scene=NAME, cameras=("FRONT",), lidar_sweeps=True,
        on_missing=random.choice(["stop", "warn"]),
    )  # fmt: skip
    try:
        with time_limit(), uncompared(unless=likely(random, 2)):
            scene = extract_scene(source, root, None, folder)
    except DatasetError as error:
        one_line(error, done)
        return True
    require_sound(scene, folder, folder)
    for sweep in scene.sweeps:
        fault = sweep_fault(sweep)
        if fault:
            assert "\n" not in fault
        else:
            require_near(read_returns(sweep), done)
    return False


@damages(8, 50)
def test_damaged_bytes_of_waymos_files(roots, tmp_path, random):
    version = random.choice(["v2", "v1"])
    with fresh(tmp_path) as folder:
        root = Path(shutil.copytree(roots[version], folder / "data"))
        path = root / (V1_FILE if version == "v1" else f"{random.choice(COMPONENTS)}/{NAME}.parquet")
        whole = path.read_bytes()
        done = mutate_bytes(random, path)
        refused = require_sound_or_one_line(root, folder / "out", random, done)
        assert refused or version == "v2" or path.read_bytes() == whole, "a checksum covers every byte"


def replace_a_number(random: Random, rows: Rows) -> None:
    row = random.choice(rows)
    holder, key = row, random.choice(list(row))
    if isinstance(row[key], list) and row[key]:
        holder, key = row[key], random.randrange(len(row[key]))
    if isinstance(holder[key], int | float):
        holder[key] = random.choice(NUMBERS if isinstance(holder[key], float) else [0, -1, 7, holder[key] + 1000])


MUTATIONS = [
    replace_a_number, replace_a_number, replace_a_number, scale_a_column, resize_a_list, delete_a_column, delete_a_row,
    repeat_a_row, exchange,
]  # fmt: skip
"""Damage that leaves each column of parquet one type."""


@damages(6, 60)
def test_damaged_values_of_v2(drive, roots, tmp_path, random):
    component = random.choice(COMPONENTS)
    rows = components(drive)[component]
    mutate = random.choice(MUTATIONS)
    mutate(random, rows)
    done = f"{component}: {mutate.__name__}"
    with fresh(tmp_path) as folder:
        root = Path(shutil.copytree(roots["v2"], folder / "data"))
        pq.write_table(pa.Table.from_pylist(rows), root / component / f"{NAME}.parquet")
        require_sound_or_one_line(root, folder / "out", random, done)


def mutate_message(random: Random, message: bytes, path: Path) -> bytes:
    """A damaged message: flipped bytes, one double replaced, cut short, or a part of it repeated."""
    kind = random.choice(["flip", "flip", "head", "double", "double", "cut", "repeat"])
    place = random.randrange(len(message))
    if kind == "flip":
        path.write_bytes(message)
        flip_bytes(random, path)
        return path.read_bytes()
    if kind == "head":  # of calibrations and poses, which come first
        place = random.randrange(3000)
        return message[:place] + bytes([random.randrange(256)]) + message[place + 1 :]
    if kind == "double":
        place = random.randrange(3000)
        return message[:place] + struct.pack("<d", random.choice(NUMBERS)) + message[place + 8 :]
    return message[:place] if kind == "cut" else message[:place] + message[place // 2 :]


@damages(6, 60)
def test_damaged_messages_of_v1_with_sound_checksums(drive, tmp_path, random):
    messages = [frame_message(drive, time) for time in drive.frames]
    number = random.randrange(len(messages))
    with fresh(tmp_path) as folder:
        messages[number] = mutate_message(random, messages[number], folder / "message")
        root = folder / "data"
        root.mkdir()
        (root / V1_FILE).write_bytes(b"".join(map(tfrecord, messages)))
        require_sound_or_one_line(root, folder / "out", random, f"frame {number}")


def test_most_damage_is_refused_and_undamaged_drives_are_read(roots, tmp_path):
    """The undamaged drives are sound, so that a refusal is one of the damage."""
    for version, root in roots.items():
        assert not require_sound_or_one_line(root, tmp_path / version, Random(0), "nothing")
