"""Bags that cannot be imported, or not as a whole: one sentence each."""

import functools
import shutil
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.bags import CLOUD, IMAGE, INFO, OUSTER, START, Messages, TestBag, imported, jpeg, store
from helpers.mutations import damages, flip_bytes, fresh, likely, mutate_bytes, mutate_words
from helpers.shown_drives import require_refused_or_sound
from helpers.table_files import time_limit
from PIL import Image

from drivesplat.cli.__main__ import main
from drivesplat.errors import DatasetError
from drivesplat.readers.drive.bag.bag_file import BagMessage
from drivesplat.readers.drive.bag.bag_import import propose
from drivesplat.readers.drive.bag.bag_map import BagLidar, PointTime
from drivesplat.readers.drive.bag.clouds import sweep_columns
from drivesplat.readers.drive.bag.images import calibration_of, image_file
from drivesplat.readers.drive.bag.layouts import cloud_layout
from drivesplat.readers.drive.bag.transforms import TransformTable
from drivesplat.readers.drive.check import check
from drivesplat.readers.drive.format import read_drive

HOUR = 3600 * 10**6
XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


@pytest.fixture(scope="module")
def whole() -> TestBag:
    return TestBag.recorded(seconds=0.5)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> tuple[dict[str, Path], str]:
    """Small bags in all containers, and the map that is proposed for them."""
    found = {}
    for container in ("ros1", "sqlite", "mcap"):
        bag = TestBag.recorded(ros1=container == "ros1", seconds=0.2)
        found[container] = bag.write(tmp_path_factory.mktemp(container), container)
    return found, propose(found["mcap"])[0]


def refused(capsys: Any, folder: Path) -> str:
    """The one sentence of a refusal, which leaves no folder."""
    said = capsys.readouterr().err
    assert said.startswith("drivesplat: ") and said.count("\n") == 1 and "Traceback" not in said
    assert not (folder / "out").exists() and not list(folder.glob(".out.*"))
    return said


def restamped(by: int) -> Any:
    """A change of the header of a message by so many microseconds."""

    def change(message: Any) -> Any:
        stamp = message.header.stamp
        message.header = Messages().header(stamp.sec * 10**6 + stamp.nanosec // 1000 + by, message.header.frame_id)
        return message

    return change


def test_bag_without_tf_proposes_to_estimate_poses(tmp_path, capsys):
    path = TestBag.recorded(seconds=0.5).without("/tf", "/tf_static").write(tmp_path)
    assert imported(path, tmp_path) == 1
    words = "tf does not connect front_optical with base_link; its frames are none: name others in the map, or state"
    assert words in refused(capsys, tmp_path)
    text = (tmp_path / "topics.yaml").read_text()
    assert "poses: null  # there are none: they are estimated" in text

    def mounted(text: str) -> str:
        mount = "mount: {translation: [1, 0, 1.5], rotation: [0.5, -0.5, 0.5, -0.5]}"
        text = text.replace("    frame: front_optical", f"    {mount}\n    frame: front_optical")
        return text.replace("    frame: top", f"    {mount}\n    frame: top")

    assert imported(path, tmp_path, edit=mounted) == 0
    drive = read_drive(tmp_path / "out")
    assert not drive.ego_poses and len(drive.frames) == 5 and check(tmp_path / "out", None) == []


def test_map_that_asks_for_tf_needs_it(whole, tmp_path, capsys):
    path = whole.without("/tf", "/tf_static").write(tmp_path)
    edit = lambda text: text.replace("poses: null", "poses: tf")  # noqa: E731
    assert imported(path, tmp_path, edit=edit) == 1
    assert "has no tf, and so no poses of the vehicle; record /tf and /tf_static, name" in refused(capsys, tmp_path)


def test_two_clocks_are_found(tmp_path, capsys):
    """The camera's clock is 3 hours late."""
    bag = TestBag.recorded(seconds=0.5).changed(IMAGE, restamped(-3 * HOUR))
    path = bag.write(tmp_path)
    edit = lambda text: text.replace("clock: log", "clock: header")  # noqa: E731
    assert imported(path, tmp_path, edit=edit) == 1
    words = "the header stamps of /front/image_raw/compressed are 3.0 hours before those of"
    assert words in refused(capsys, tmp_path)
    assert imported(path, tmp_path) == 0
    assert "clock: log  # the header stamps of /front/image_raw/compressed" in capsys.readouterr().out
    assert [frame.timestamp - START for frame in read_drive(tmp_path / "out").frames[:2]] == [5_000, 105_000]


def test_recording_of_another_day_keeps_its_stamps(tmp_path):
    """A bag that was played and recorded again: all stamps are as old."""
    bag = TestBag.recorded(seconds=0.5)
    later = TestBag(bag.make, [(topic, log + 30 * HOUR, message) for topic, log, message in bag.messages])
    assert imported(later.write(tmp_path), tmp_path) == 0
    assert read_drive(tmp_path / "out").frames[0].timestamp == START


def test_gaps_are_said(tmp_path, capsys):
    bag = TestBag.recorded(seconds=2.0)
    bag.messages = [m for m in bag.messages if m[0] != CLOUD or not START + 350_000 < m[1] < START + 1_550_000]
    assert imported(bag.write(tmp_path), tmp_path) == 0
    assert "note: top: 1 gap without a sweep, the longest of 1.3 s from 0.3 s on" in capsys.readouterr().out


@pytest.mark.parametrize("container", ["ros1", "sqlite", "mcap"])
def test_truncated_bag_names_the_remedy(container, tmp_path, capsys):
    path = TestBag.recorded(ros1=container == "ros1", seconds=0.5).write(tmp_path, container)
    (file,) = path.glob("*.db3") if container == "sqlite" else [path]
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    assert imported(path, tmp_path) == 1
    said = refused(capsys, tmp_path)
    remedy = {"ros1": "`rosbag reindex`", "sqlite": "`sqlite3 FILE .recover`", "mcap": "`mcap recover`"}[container]
    assert "is truncated or was not closed" in said and remedy in said


def test_messages_that_the_index_counts_and_the_file_lacks_are_said(tmp_path, capsys):
    """Zeros in the middle of a file whose index is whole."""
    path = TestBag.recorded(seconds=0.5).write(tmp_path)
    assert imported(path, tmp_path) == 0
    topics, content = tmp_path / "topics.yaml", bytearray(path.read_bytes())
    middle = len(content) // 3
    content[middle : middle + 4000] = bytes(4000)
    path.write_bytes(content)
    assert main(["import", "bag", str(path), "--map", str(topics), "--out", str(tmp_path / "again")]) == 0
    written = sum(frame.camera == "front" for frame in read_drive(tmp_path / "again").frames)
    said = f"note: front: the index of the bag counts 5 messages, {written} are there: the bag is damaged"
    assert written < 5 and said in capsys.readouterr().out


def test_one_grey_camera_of_eight_is_named(tmp_path, capsys):
    bag = TestBag.recorded(seconds=0.3).without(IMAGE, INFO, CLOUD)
    for number in range(8):
        for stamp in range(START, START + 300_000, 100_000):
            data = jpeg(number, "L" if number == 3 else "RGB")
            image = bag.make.compressed(stamp, "front_optical", data)
            bag.messages.append((f"/camera{number}/image_raw/compressed", stamp, image))
            bag.messages.append((f"/camera{number}/camera_info", stamp, bag.make.info(stamp, "front_optical")))
    assert imported(bag.write(tmp_path), tmp_path) == 0
    said = capsys.readouterr().out
    assert (
        "note: camera3 records grey images, the other cameras colours: leave it out of `cameras` in the config" in said
    )
    assert "camera3:  # grey images beside colour ones" in said
    assert len(read_drive(tmp_path / "out").frames) == 24 and check(tmp_path / "out", None) == []


def test_camera_without_camera_info_needs_its_calibration(whole, tmp_path, capsys):
    path = whole.without(INFO).write(tmp_path)
    assert imported(path, tmp_path) == 1
    assert "camera front has no CameraInfo; state its calibration in the map: calibration:" in refused(capsys, tmp_path)
    calibration = "calibration: {width: 64, height: 48, K: [[50, 0, 31], [0, 50, 24], [0, 0, 1]]}"
    assert imported(path, tmp_path, edit=lambda text: text.replace("info: null", calibration)) == 0
    assert read_drive(tmp_path / "out").cameras["front"].K[0] == (50.0, 0.0, 31.0)


def test_images_of_another_size_than_their_calibration(tmp_path, capsys):
    bag = TestBag.recorded(seconds=0.5)
    bag.messages = [one for one in bag.messages if one[0] != INFO]
    bag.messages.append((INFO, START, bag.make.info(START, "front_optical", width=128, height=96)))
    assert imported(bag.write(tmp_path), tmp_path) == 1
    words = "is 64x48, but its CameraInfo on /front/camera_info is of images of 128x96; state a calibration"
    assert words in refused(capsys, tmp_path)


def test_unknown_point_layout_is_not_proposed_and_refused(whole, tmp_path, capsys):
    rows = np.zeros(5, dtype=[("range", "<f4"), ("azimuth", "<f4")])
    bag = TestBag(whole.make, list(whole.messages))
    for stamp in (START, START + 100_000, START + 200_000):
        bag.messages.append(("/polar/points", stamp, bag.make.cloud(stamp, "top", rows)))
    path = bag.write(tmp_path)
    edit = lambda text: text.replace("points: /top/points", "points: /polar/points")  # noqa: E731
    assert imported(path, tmp_path, edit=edit) == 1
    out = capsys.readouterr()
    assert "# not used: /polar/points  # its cloud has no field x, y, z; its fields are range, azimuth" in out.out
    assert "the first sweep on /polar/points has no field x, y, z" in out.err


def test_damaged_and_repeated_messages_are_counted(tmp_path, capsys):
    bag = TestBag.recorded(seconds=1.0)
    images = [one for one in bag.messages if one[0] == IMAGE]
    images[4][2].data = images[4][2].data[:-40]
    bag.messages.append((IMAGE, images[6][1] + 10, images[6][2]))
    empty = [one for one in bag.messages if one[0] == CLOUD][5]
    bag.messages.remove(empty)
    stamp = START + 500_000
    bag.messages.append((CLOUD, stamp, bag.make.cloud(stamp, "top", np.zeros(2, OUSTER))))
    assert imported(bag.write(tmp_path), tmp_path) == 0
    said = capsys.readouterr().out
    assert "note: front: 1 image of 11 left out as damaged; the first one is a truncated JPEG" in said
    assert "note: front: 1 image left out with the timestamp of another one" in said
    assert "note: top: 1 sweep of 10 left out as damaged; the first one has no points" in said
    assert check(tmp_path / "out", None) == []


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("tf2_msgs/msg/TFMessage", SimpleNamespace(transforms=[SimpleNamespace(child_frame_id="base_link")])),
        ("nav_msgs/msg/Odometry", SimpleNamespace(header=None)),
        ("sensor_msgs/msg/Image", SimpleNamespace(height=1, width=1)),
    ],
)
def test_a_bag_that_defines_its_messages_without_fields_has_damaged_ones(kind, content):
    message = BagMessage("/some", 0, kind, b"", SimpleNamespace(deserialize=lambda data, kind: content))
    with pytest.raises(DatasetError, match=r"a message on /some is damaged \(AttributeError: .* has no attribute"):
        message.content()


def test_transforms_that_are_none_are_counted(tmp_path, capsys):
    """A gimbal without a rotation, and one pose of the vehicle of twenty is none."""
    bag = TestBag.recorded(seconds=0.5)
    transforms = [one for one in bag.messages if one[0] == "/tf"]
    transforms[20][2].transforms[1].transform.rotation.w += 0.5
    gimbal = bag.make.transforms(START, ("base_link", "gimbal", np.eye(4)))
    gimbal.transforms[0].transform.rotation.w = 0.0
    bag.messages.append(("/tf", START, gimbal))
    assert imported(bag.write(tmp_path), tmp_path) == 0
    said = capsys.readouterr().out
    assert "note: transforms of base_link to odom left out as damaged: 1" in said
    assert "note: transforms of gimbal to base_link left out as damaged: 1" in said
    assert len(read_drive(tmp_path / "out").frames) == 5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("clock: header", "clock: sundial"), "clock is 'sundial'"),
        (("images: /front", "images: /back"), "cameras.front.images is /back/image_raw/compressed, on which"),
        (("info: /front/camera_info", "info: /tf"), "has no CameraInfo; topics with it: /front/camera_info"),
        (("points: /top/points", "points: /tf"), "has no PointCloud2; topics with it: /top/points"),
        (("poses: tf", "poses: /tf"), "has no Odometry; topics with it: none"),
        (("world: map", "world: moon"), "tf does not connect base_link with moon"),
        (("frame: top", "frame: roof"), "tf does not connect roof with base_link"),
        (("sensor: front", "sensor: rear"), "key_frames.sensor must be one of: front, top"),
        (("  top:", "  front:"), "a camera and a LiDAR have the same name"),
        (("  top:", "  ../top:"), "must have letters, digits, - and _ only"),
        (("ring: ring", "ring: rings"), "the first sweep on /top/points has no field rings"),
        (("unit: ns", "unit: us"), "check its unit, what it counts from, and revolution_s in the map"),
        (("unit: ns", "unit: d"), "lidars.top.time.unit is 'd'"),
        (("time: {field: t, unit: ns, counts_from: stamp}", "time: null"), "motion_compensated: false needs the times"),
        (("stamp: middle", "speed: 3"), "cameras.front.speed is no key"),
        (("rotation: [1, 0, 0, 0]", "rotation: [1, 1, 0, 0]"), "vehicle_to_ego"),
        (("clock: header", "clock: [header"), "not YAML"),
        (("clock: header", "- clock"), "not YAML"),
    ],
)
def test_maps_that_do_not_fit_are_refused(change, words, written, tmp_path, capsys):
    (bags, text), topics = written, tmp_path / "topics.yaml"
    assert change[0] in text
    topics.write_text(text.replace(*change))
    out = tmp_path / "out"
    assert main(["import", "bag", str(bags["mcap"]), "--map", str(topics), "--out", str(out)]) == 1
    assert words in refused(capsys, tmp_path)


def test_paths_options_and_windows_that_cannot_be(whole, tmp_path, capsys):
    path, topics, out = whole.write(tmp_path), tmp_path / "topics.yaml", tmp_path / "out"
    (tmp_path / "empty").mkdir()
    (tmp_path / "note.txt").write_text("x")
    (tmp_path / "text.mcap").write_text("no bag at all")
    propose = ["--propose", str(topics)]
    for arguments, words in (
        ([str(tmp_path / "none.mcap"), *propose], "none.mcap is missing"),
        ([str(tmp_path / "empty"), *propose], "is no bag: it has no metadata.yaml"),
        ([str(tmp_path / "note.txt"), *propose], "is no bag: bags are folders"),
        ([str(tmp_path / "text.mcap"), *propose], "cannot be read as a bag"),
        ([str(path), "--map", str(topics)], "--map and --out belong together"),
        ([str(path), *propose, "--start", "9", "--end", "3"], "are no window: 0 <= start < end"),
        ([str(path), *propose, "--start", "nan"], "are no window"),
        ([str(path), *propose, "--start", "1e6"], "is beyond the bag, which has 0."),
        ([str(path), "--map", str(topics), "--out", str(out)], "the map of topics cannot be read"),
    ):
        assert main(["import", "bag", *arguments]) == 1
        assert words in refused(capsys, tmp_path)
    topics.write_text("x")
    assert main(["import", "bag", str(path), *propose]) == 1
    assert "topics.yaml is there already" in refused(capsys, tmp_path) and topics.read_text() == "x"
    topics.unlink()
    out.mkdir()
    (out / "mine").touch()
    assert imported(path, tmp_path) == 1
    assert "is not empty; name a new folder" in capsys.readouterr().err and (out / "mine").exists()


def test_bag_without_sensors_is_refused(whole, tmp_path, capsys):
    path = whole.without(IMAGE, CLOUD, INFO).write(tmp_path)
    assert imported(path, tmp_path) == 1
    assert "has no images and no point clouds: there is nothing to import" in refused(capsys, tmp_path)


@damages(10, 200)
def test_damaged_bags_are_refused_in_one_line_or_sound(written, tmp_path, capsys, random):
    """Damage to the bytes of a bag or to the words of its map."""
    (bags, text), container = written, random.choice(["ros1", "sqlite", "mcap"])
    source = bags[container]
    with fresh(tmp_path) as folder:
        copied, topics = folder / source.name, folder / "topics.txt"
        if source.is_dir():
            shutil.copytree(source, copied)
        else:
            shutil.copy(source, copied)
        topics.write_text(text)
        if likely(random, 8):
            target = random.choice(sorted(copied.iterdir())) if copied.is_dir() else copied
            damage = random.choice([mutate_bytes, mutate_words if target.suffix == ".yaml" else near_the_end])
            done = f"{container}: {damage(random, target)}"
        else:
            done = mutate_words(random, topics)
        if likely(random, 3):
            command = ["--propose", str(folder / "proposed.yaml")]
        else:
            command = ["--map", str(topics), "--out", str(folder / "out")]
        convert = functools.partial(main, ["import", "bag", str(copied), *command])
        if command[0] == "--map":
            require_refused_or_sound(convert, folder / "out", capsys, done)
        elif convert():
            assert capsys.readouterr().err.count("\n") == 1, done


def near_the_end(random: Any, path: Path) -> str:
    """Replaces bytes of the last kilobytes, where indices are."""
    content = path.read_bytes()
    cut = max(0, len(content) - 4000)
    tail = path.with_name("tail")
    tail.write_bytes(content[cut:])
    flip_bytes(random, tail)
    path.write_bytes(content[:cut] + tail.read_bytes())
    tail.unlink()
    return f"{path.name}: index"


@dataclass
class Deserializer:
    """What reads messages in place of an open bag."""

    def deserialize(self, data: bytes, kind: str) -> Any:
        return store(False).deserialize_cdr(data, kind)


def sound(content: Any, table: TransformTable) -> None:
    """Converts a message; what comes of it can be used."""
    if hasattr(content, "point_step"):
        time = PointTime(field="t", unit="ns", counts_from="stamp")
        lidar = BagLidar(
            points="/t", frame="t", time=time, ring="ring", intensity="intensity", motion_compensated=False
        )
        cloud_layout(content)
        columns = sweep_columns(content, lidar)
        assert len({len(values) for values in columns.values()}) == 1
        assert all(len(values) and np.isfinite(values).all() for values in columns.values())
    elif hasattr(content, "binning_x"):
        calibration, turn = calibration_of(content, rectified=False)
        assert calibration.K[0][0] > 0 and np.isfinite(calibration.K).all() and np.array_equal(turn, np.eye(3))
    elif hasattr(content, "transforms"):
        for one in content.transforms:
            table.add(one.header, one.child_frame_id, 0, one.transform.translation, one.transform.rotation)
        for one in table.tree().edges:
            assert np.isfinite(one.poses(np.zeros(1, dtype=np.int64))).all()
    else:
        file = image_file(content, "png")
        with Image.open(BytesIO(file.data)) as image:
            assert image.size == file.size


def test_two_hundred_damaged_messages_are_refused_or_sound(whole):
    """Bytes of serialized messages are replaced or cut; nothing but DatasetError is raised."""
    random, types, refusals = Random(0), store(False), 0
    raw = Messages().raw(START, "front", "bayer_rggb8", (8, 6), np.zeros((6, 8), dtype=np.uint8))
    kinds = [whole.messages[0][2], *(m for topic, _, m in whole.messages[-4:]), raw]
    for number in range(200):
        message = kinds[number % len(kinds)]
        data = bytearray(types.serialize_cdr(message, message.__msgtype__))
        for _ in range(random.choice([1, 5, 30])):
            data[random.randrange(4, min(len(data), random.choice([60, 300, 10**6])))] = random.randrange(256)
        data = data[: random.randrange(len(data))] if random.random() < 0.2 else data
        damaged = BagMessage("/topic", 0, message.__msgtype__, bytes(data), Deserializer())
        try:
            with time_limit():
                sound(damaged.content(), TransformTable())
        except DatasetError as error:
            refusals += 1
            assert "\n" not in str(error) and len(str(error)) < 1000
    assert 50 < refusals < 195
