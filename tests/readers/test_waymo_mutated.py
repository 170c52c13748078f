"""200 damaged Waymo drives: read as a sound scene or refused in one line, in time."""

import math
import shutil
import struct
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers import drives
from helpers.mutations import damages, flip_bytes, fresh, likely, mutate_bytes
from helpers.table_files import time_limit
from helpers.waymo_drive import NAME, Drive, tiny_drive
from helpers.waymo_files import components, frame_message, tfrecord, write_v1, write_v2
from hypothesis import assume

from drivesplat.errors import DatasetError
from drivesplat.preprocess.extract import extract_scene
from drivesplat.readers.sweeps import read_returns, sweep_fault
from drivesplat.readers.waymo.names import COMPONENTS
from drivesplat.scene.scene import Scene, read_scene, write_scene

V1_FILE = f"segment-{NAME}_with_camera_labels.tfrecord"
NUMBERS = [0.0, -1.0, 1e-30, 1e9, 1e30, 1e300, math.nan, math.inf, -math.inf]


@pytest.fixture(scope="module")
def drive(small_root) -> Drive:
    whole = tiny_drive(small_root, drives.SMALL, lasers=(1, 2))[0]
    return replace(whole, images=[image for image in whole.images if image.camera == 1])


@pytest.fixture(scope="module")
def roots(drive, tmp_path_factory) -> dict[str, Path]:
    return {
        "v2": write_v2(tmp_path_factory.mktemp("v2"), drive),
        "v1": write_v1(tmp_path_factory.mktemp("v1"), drive),
    }


def require_sound_or_one_line(root: Path, folder: Path, random: Random, done: object) -> bool:
    """Reads a drive and its sweeps; whether it was refused."""
    source = drives.source(
        dataset="mine", reader="waymo", version="", scene=NAME, cameras=("FRONT",), lidar_sweeps=True,
        on_missing=random.choice(["stop", "warn"]),
    )  # fmt: skip
    try:
        with time_limit(), drives.uncompared(unless=likely(random, 2)):
            scene = extract_scene(source, root, None, folder)
    except DatasetError as error:
        message = str(error)
        assert "\n" not in message and 10 < len(message) < 1000 and message.isprintable(), done
        return True
    require_sound(scene, folder)
    return False


def require_sound(scene: Scene, folder: Path) -> None:
    times = scene.key_frame_timestamps
    assert 0 < len(scene.frames) <= len(times) and (np.diff(times) > 0).all()
    poses = [pose for frame in scene.frames for pose in (frame.camera_to_world, frame.ego_to_world)]
    poses += [sweep.sensor_to_world for sweep in scene.sweeps]
    poses += [pose for track in scene.tracks for pose in track.object_to_world]
    assert np.isfinite(poses).all() and np.abs(poses).max() < 3e8
    np.testing.assert_allclose(np.linalg.det(np.array(poses)[:, :3, :3]), 1.0, atol=1e-6)
    assert all(b.timestamp > a.timestamp for a, b in pairwise(scene.frames))
    assert all(folder in Path(frame.image_path).parents for frame in scene.frames)
    assert len({frame.token for frame in scene.frames}) == len(scene.frames)
    for track in scene.tracks:
        assert ((track.size > 0) & (track.size <= 1000)).all() and (np.diff(track.timestamps) > 0).all()
    for sweep in scene.sweeps:
        fault = sweep_fault(sweep)
        if fault:
            assert "\n" not in fault
        else:
            returns = read_returns(sweep)
            assert np.linalg.norm(returns.points, axis=1).max() < 2000.0
            assert ((returns.intensity >= 0) & (returns.intensity <= 1)).all()
    write_scene(folder / "scene.json", scene)
    assert len(read_scene(folder / "scene.json").tracks) == len(scene.tracks)


@damages(15, 50)
def test_damaged_bytes_of_v2(roots, tmp_path, random):
    with fresh(tmp_path) as folder:
        root = Path(shutil.copytree(roots["v2"], folder / "data"))
        done = mutate_bytes(random, root / random.choice(COMPONENTS) / f"{NAME}.parquet")
        require_sound_or_one_line(root, folder / "out", random, done)


def mutate_rows(random: Random, rows: list[dict[str, Any]]) -> str:
    """Damages the rows of a component in place; returns what was done."""
    kind = random.choice(["value", "value", "number", "number", "number", "list", "column", "row", "twice", "order"])
    row = random.choice(rows)
    name = random.choice(list(row))
    if kind == "value":
        for one in rows:  # parquet has one type for a column
            one[name] = None if one is not row else one[name]
        row[name] = random.choice([None, b"\xff\xd8junk", "junk", 2**40, -1, 0.5])
    elif kind == "number" and isinstance(row[name], list) and row[name]:
        row[name][random.randrange(len(row[name]))] = random.choice(
            NUMBERS if isinstance(row[name][0], float) else [0, -1, 7]
        )
    elif kind == "number" and isinstance(row[name], float):
        row[name] = random.choice(NUMBERS)
    elif kind == "number" and isinstance(row[name], int):
        row[name] += random.choice([-1, 1, 5, 1000, -(10**6)])
    elif kind == "list" and isinstance(row[name], list):
        row[name] = random.choice([row[name][:-1], row[name] * 2, []])
    elif kind == "column":
        for one in rows:
            one.pop(name, None)
    elif kind == "row":
        rows.remove(row)
    elif kind == "twice":
        rows.append(dict(row))
    elif kind == "order":
        random.shuffle(rows)
    return f"{kind} {name}"


@damages(15, 60)
def test_damaged_values_of_v2(drive, roots, tmp_path, random):
    component = random.choice(COMPONENTS)
    rows = components(drive)[component]
    done = f"{component}: {mutate_rows(random, rows)}"
    with fresh(tmp_path) as folder:
        root = Path(shutil.copytree(roots["v2"], folder / "data"))
        pq.write_table(pa.Table.from_pylist(rows), root / component / f"{NAME}.parquet")
        require_sound_or_one_line(root, folder / "out", random, done)


@damages(8, 30)
def test_damaged_bytes_of_v1(roots, tmp_path, random):
    with fresh(tmp_path) as folder:
        root = Path(shutil.copytree(roots["v1"], folder / "data"))
        whole = (root / V1_FILE).read_bytes()
        done = mutate_bytes(random, root / V1_FILE)
        assume((root / V1_FILE).read_bytes() != whole)
        assert require_sound_or_one_line(root, folder / "out", random, done), "a checksum covers every byte"


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


@damages(15, 60)
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
