"""Faults of Waymo's files: each is refused in a sentence, or handled."""

import os
import re
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers import drives
from helpers.mutations import fresh
from helpers.table_files import time_limit
from helpers.waymo_drive import NAME, Drive, panoptic, tiny_drive
from helpers.waymo_files import tfrecord, write_v1, write_v2

from drivesplat.errors import DatasetError, ResultError
from drivesplat.preprocess.extract import extract_scene
from drivesplat.readers.waymo.layout import camera_names, find_root, segment_files, table_files
from drivesplat.readers.waymo.v1 import masked_crc
from drivesplat.scene.scene import Scene

pytestmark = pytest.mark.usefixtures("uncompared")

WRITERS = {"v2": write_v2, "v1": write_v1}
V1_FILE = f"segment-{NAME}_with_camera_labels.tfrecord"
OTHER = "1234567890123456789_900_000_920_000"


@pytest.fixture(scope="module")
def drive(small_root) -> Drive:
    return tiny_drive(small_root, drives.SMALL, lasers=(1, 2))[0]


@pytest.fixture(scope="module")
def roots(drive, tmp_path_factory) -> dict[str, Path]:
    return {version: WRITERS[version](tmp_path_factory.mktemp(version), drive) for version in WRITERS}


@pytest.fixture
def written(tmp_path) -> Callable[..., Path]:
    """Writes a drive as v2 or v1."""
    return lambda version, drive: WRITERS[version](tmp_path / version, drive)


def extracted(root: Path, folder: Path, **changes: Any) -> Scene:
    given = {"dataset": "mine", "reader": "waymo", "scene": NAME, "cameras": ("FRONT",), "sweeps": False}
    return extract_scene(drives.source(**{**given, **changes}), root, None, folder)


def refusal(root: Path, folder: Path, **changes: Any) -> str:
    """The sentence that refuses a drive."""
    with pytest.raises(DatasetError) as stopped:
        extracted(root, folder, **changes)
    message = str(stopped.value)
    assert "\n" not in message and 10 < len(message) < 600
    return message


def first(items: list, **changes: Any) -> list:
    """The items, the first one changed."""
    return [replace(items[0], **changes), *items[1:]]


def test_a_folder_without_segments_is_refused_with_what_to_do(tmp_path):
    with pytest.raises(DatasetError, match=r"there is no folder .*nowhere; docs/waymo\.md"):
        find_root(str(tmp_path / "nowhere"), "")
    with pytest.raises(DatasetError, match=r"looked for \*\.tfrecord and camera_image/\*\.parquet"):
        find_root(str(tmp_path), "")


@pytest.mark.parametrize("kind", ["pipe", "folder", "loop", "dangling"])
def test_segments_that_are_no_files_are_refused_in_the_plan(kind, tmp_path):
    path = tmp_path / V1_FILE
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(path if kind == "loop" else tmp_path / "nowhere")
    with time_limit(), pytest.raises(DatasetError, match=rf"scene {NAME}: .*{V1_FILE} is not a file"):
        table_files(find_root(str(tmp_path), ""), "", NAME)


def test_a_file_of_another_kind_holds_no_frames(tmp_path):
    """Waymo's motion dataset: a tf.train.Example, which begins with a map (1) of features (1) by name (1), and a
    Scenario, which begins with times as doubles (1) and has its name elsewhere (5)."""

    def field(number: int, content: bytes) -> bytes:
        return bytes([number << 3 | 2, len(content)]) + content

    example = field(1, field(1, field(1, b"traffic_light_state/past/x") + field(2, b"")))
    scenario = b"\x09" + struct.pack("<d", 0.1) + field(5, b"637f20cafde22ff8")
    for content in (example, scenario):
        (tmp_path / V1_FILE).write_bytes(tfrecord(content))
        said = refusal(tmp_path, tmp_path)
        assert V1_FILE in said and "holds no frames" in said and "of another kind" in said


@pytest.mark.parametrize("version", WRITERS)
def test_an_unknown_segment_is_refused_with_those_there_are(version, roots, tmp_path):
    assert find_root(str(roots[version]), "") == roots[version] and len(camera_names(roots[version], "")) == 5
    assert f"scene 77 is not there; in {roots[version]} there are: {NAME}" in refusal(
        roots[version], tmp_path, scene="77"
    )


def test_the_beginning_of_a_name_selects_a_segment_unless_several_begin_so(roots, tmp_path):
    root = Path(shutil.copytree(roots["v1"], tmp_path / "data"))
    assert segment_files(root, "", NAME[:19]).name == NAME
    shutil.copy(root / V1_FILE, root / f"{OTHER}.tfrecord")
    assert table_files(root, "", NAME) == [root / V1_FILE]
    assert f"begins the names of several segments; in {root} there are: {NAME}, {OTHER}" in refusal(
        root, tmp_path, scene=NAME[:19]
    )


def test_both_versions_of_a_segment_are_refused_unless_one_is_named(drive, tmp_path):
    write_v1(write_v2(tmp_path / "data", drive), drive)
    sentence = refusal(tmp_path / "data", tmp_path / "results")
    assert f"as v1 ({V1_FILE}) and as v2; set datasets.<name>.version to v1 or v2" in sentence
    for version in WRITERS:
        assert extracted(tmp_path / "data", tmp_path / "results", version=version).version == version


def drop_column(path: Path, name: str) -> None:
    pq.write_table(pq.read_table(path).drop_columns([name]), path)


def retype_column(path: Path, name: str) -> None:
    table = pq.read_table(path)
    place = table.schema.get_field_index(name)
    pq.write_table(table.set_column(place, name, pa.array([0.5] * len(table))), path)


POSE, VALUES = "[CameraImageComponent].pose.transform", "[LiDARComponent].range_image_return1.values"
V2_FAULTS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "missing": ("lidar_pose", Path.unlink, f"lidar_pose/{NAME}.parquet is missing in {{root}}; docs/waymo.md"),
    "no column": ("camera_image", lambda path: drop_column(path, POSE), f"{{path}} has no column {POSE}"),
    "another type": (
        "lidar", lambda path: retype_column(path, VALUES), f"{{path}}: its column {VALUES} is of type double",
    ),
    "empty": ("camera_image", lambda path: os.truncate(path, 0), "{path} cannot be read ("),
    "truncated": ("lidar", lambda path: os.truncate(path, path.stat().st_size // 2), "{path} cannot be read ("),
    "cut": ("vehicle_pose", lambda path: os.truncate(path, path.stat().st_size - 1), "{path} cannot be read ("),
}  # fmt: skip


@pytest.mark.parametrize("fault", V2_FAULTS)
def test_missing_and_damaged_components_are_named(fault, roots, tmp_path):
    component, change, words = V2_FAULTS[fault]
    root = Path(shutil.copytree(roots["v2"], tmp_path / "data"))
    path = root / f"{component}/{NAME}.parquet"
    change(path)
    assert words.format(root=root, path=path) in refusal(root, tmp_path)


def test_a_truncated_tfrecord_and_a_wrong_checksum_are_named_with_the_record(roots, tmp_path):
    whole = (roots["v1"] / V1_FILE).read_bytes()
    for cut in (1, 14, 5000, -3):
        (tmp_path / V1_FILE).write_bytes(whole[:cut])
        sentence = refusal(tmp_path, tmp_path / "out")
        assert re.search(r"record [02] of .* is truncated; download the file again", sentence), cut
    for place, part in ((3, "length"), (9, "length"), (100, "data"), (-2, "data")):
        content = bytearray(whole)
        content[place] ^= 4
        (tmp_path / V1_FILE).write_bytes(content)
        sentence = refusal(tmp_path, tmp_path / "out")
        assert f"the checksum (CRC-32C) of its {part} differs" in sentence and "record " in sentence


def test_the_mask_of_a_checksum_is_that_of_tensorflow():
    """The CRC-32C of '123456789' is e3069283 (RFC 3720); the mask rotates it by 15 bits and adds a282ead8."""
    assert masked_crc(b"123456789") == (0x2507C60D + 0xA282EAD8) % 2**32


def test_a_file_of_another_segment_is_named(drive, tmp_path):
    root = write_v1(tmp_path / "v1", replace(drive, name=OTHER))
    (root / V1_FILE.replace(NAME, OTHER)).rename(root / V1_FILE)
    assert f"is a frame of segment '{OTHER}', and the file is called {NAME}" in refusal(root, tmp_path)
    root = write_v2(tmp_path / "v2", drive)
    shutil.copy(write_v2(tmp_path / "other", replace(drive, name=OTHER)) / f"lidar/{OTHER}.parquet", root / "lidar")
    (root / f"lidar/{OTHER}.parquet").replace(root / f"lidar/{NAME}.parquet")
    assert f"holds segment '{OTHER}', not {NAME}" in refusal(root, tmp_path)


@pytest.mark.parametrize("version", WRITERS)
def test_a_frame_without_image_is_named_or_left_out(version, drive, written, tmp_path):
    lost = next(i for i, image in enumerate(drive.images) if image.camera == 1 and image.frame != drive.images[0].frame)
    images = list(drive.images)
    images[lost : lost + 1] = [] if version == "v1" else [replace(images[lost], content=b"")]
    root = written(version, replace(drive, images=images))
    sentence = refusal(root, tmp_path / "results")
    assert f"key frame 1: frame {drive.images[lost].frame} has no image of camera FRONT" in sentence
    assert "set extract.on_missing: warn" in sentence
    scene = extracted(root, tmp_path / "results", on_missing="warn")
    assert scene.missing_images == 1 and [frame.sample_index for frame in scene.frames] == [0, 2]


@pytest.mark.parametrize("version", WRITERS)
def test_a_drive_without_boxes_or_lidar_is_a_static_one(version, drive, written, tmp_path):
    scene = extracted(written(version, replace(drive, boxes=[], sweeps=[])), tmp_path / "results")
    assert scene.tracks == scene.sweeps == scene.lidars == () and len(scene.frames) == 3


def wrong_values(d: Drive) -> dict[str, tuple[dict[str, Any], str]]:
    """What replaces parts of a drive, and the words of the refusal."""
    top, front = d.lasers
    sweep, box, image = d.sweeps[0], d.boxes[0], d.images[0]
    short = {"values": sweep.values[:40], "poses": sweep.poses[:40]}
    later = [*d.sweeps[:2], replace(d.sweeps[2], values=d.sweeps[2].values[:40], poses=d.sweeps[2].poses[:40])]
    rows = "its range image has 40 rows, and its laser 64 beam inclinations"
    inclinations = np.degrees(top.inclinations)
    return {
        "an image pose that scales": (
            {"images": first(d.images, pose=image.pose * np.array([2.0, 2.0, 2.0, 1.0])[:, None])},
            r"image FRONT of frame \d+: its transform is not rigid",
        ),
        "a frame pose with NaN": (
            {"frames": d.frames | {min(d.frames): np.full((4, 4), np.nan)}},
            r"frame \d+: its transform is .* 4x4 matrix of finite numbers",
        ),
        "an image time of another clock": (
            {"images": first(d.images, seconds=12.5)},
            r"image FRONT of frame \d+: its time is 12\.5 s, more than a second from that of its frame",
        ),
        "a focal length of zero": (
            {"cameras": first(d.cameras, intrinsic=[0.0] * 9)}, r"camera FRONT: its camera matrix is singular",
        ),
        "a camera without calibration": (
            {"cameras": d.cameras[1:]}, r"camera FRONT: segment \w+ has no calibration of it",
        ),
        "a laser without calibration": (
            {"lasers": [front]}, r"laser TOP: segment \w+ has range images of it, but no calibration",
        ),
        "inclinations from the top": (
            {"lasers": [top, replace(front, lowest=0.5, highest=0.1)]},
            r"laser FRONT: its least beam inclination 0\.5 is not below the greatest, 0\.1",
        ),
        "inclinations in degrees": (
            {"lasers": [replace(top, inclinations=inclinations), front]}, r"laser TOP: its beam elevations .* radians",
        ),
        "two boxes of one object": ({"boxes": [*d.boxes, box]}, r"box .* it has two boxes in frame \d+"),
        "a box without size": (
            {"boxes": first(d.boxes, size=np.zeros(3))},
            r"box .* in frame \d+: its size is .* three positive numbers",
        ),
        "a box at infinity": (
            {"boxes": first(d.boxes, center=np.array([np.inf, 0.0, 0.0]))},
            r"box .* in frame \d+: its centre .* not finite",
        ),
        "an image twice": ({"images": [*d.images, image]}, r"image FRONT of frame \d+: the segment has it twice"),
        "a sweep twice": ({"sweeps": [*d.sweeps, sweep]}, r"sweep TOP/\d+: the segment has it twice"),
        "fewer rows than inclinations": ({"sweeps": first(d.sweeps, **short)}, f"laser TOP: {rows}"),
        "fewer rows later": ({"sweeps": [*later, *d.sweeps[3:]]}, rows),
        "fewer poses of pixels": (
            {"sweeps": first(d.sweeps, poses=sweep.poses[:, :50])},
            r"sweep TOP/\d+: its range image is 64x120, and the poses of its pixels are 64x50",
        ),
        "no poses of pixels": (
            {"sweeps": first(d.sweeps, poses=None)},
            r"sweep TOP/\d+: (.*lidar_pose.* has no poses of its pixels|its range image has 0 values)",
        ),
        "a label that is no image": (
            labelled(d, content=b"\x89PNG junk"), r"label FRONT/\d+: its panoptic label is corrupt",
        ),
        "a label of another divisor": (labelled(d, divisor=3), r"label FRONT/\d+: .* no classes from 0 to 28"),
        "a label without divisor": (labelled(d, divisor=0), r"label FRONT/\d+: .* with the divisor 0"),
    }  # fmt: skip


def labelled(drive: Drive, **changes: Any) -> dict[str, Any]:
    return {"labels": [replace(panoptic(drive.images[0].frame, 1, np.full((27, 48), 20)), **changes)]}


@pytest.mark.parametrize("version", WRITERS)
def test_wrong_values_are_named_in_both_versions(version, drive, tmp_path):
    for fault, (change, words) in wrong_values(drive).items():
        with fresh(tmp_path) as folder:
            root = WRITERS[version](folder / "data", replace(drive, **change))
            assert re.search(words, refusal(root, folder / "results")), fault


@pytest.mark.parametrize("name", ["images", "sweeps"])
def test_a_file_that_cannot_be_written_is_named(name, roots, tmp_path):
    (tmp_path / name).touch()  # where a folder has to be
    with pytest.raises(ResultError, match=rf"{tmp_path}/{name}/.* cannot be written"):
        extracted(roots["v2"], tmp_path)
