"""Every malformed value of the tables ends with one sentence that names its record."""

import dataclasses
import json
import logging
import re
from pathlib import Path

import pytest
from helpers.drives import KEY_FRAME_US, START_US
from helpers.table_files import copy_of, edit, extracted, row

from drivesplat.errors import DatasetError
from drivesplat.readers.drive_checks import jumps
from drivesplat.readers.nuscenes.layout import camera_names
from drivesplat.readers.nuscenes.scene_tables import index_tables

pytestmark = pytest.mark.usefixtures("uncompared")

SAMPLE, IMAGE, SWEEP = "0001 sample 1", "0001 CAM_FRONT 2", "0001 LIDAR_TOP 1"
BETWEEN = "0001 CAM_FRONT 3"
BOX = "0001 annotation 1 1"
CAMERA, LIDAR = "calibrated CAM_FRONT", "calibrated LIDAR_TOP"


@pytest.fixture
def root(small_root, tmp_path) -> Path:
    return copy_of(small_root, tmp_path)


def refusal(root: Path, **changes) -> str:
    with pytest.raises(DatasetError) as failure:
        extracted(root, **changes)
    assert "\n" not in str(failure.value)
    assert len(str(failure.value)) < 600, "a long value is shortened"
    return str(failure.value)


DEEP, NAN, FAR = [[[[[[[[1.0]]]]]]]], float("nan"), [1.0, 2.0, 3.0]
NOT_A_POSITION = [
    None, "1, 2, 3", ["1", "2", "3"], [FAR], [1.0, 2.0, [3.0]], [1.0, 2.0], [*FAR, 4.0], {}, 7, DEEP, [True, 0.0, 0.0],
    [1e300, 0.0, 0.0], [0.0, -1.1e8, 0.0], [10**400, 0, 0], [NAN, 0.0, 0.0], [None, 0.0, 0.0], [0.0, float("inf"), 0.0],
]  # fmt: skip
NOT_A_ROTATION = [
    None, "1000", ["1", "0", "0", "0"], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0], [[1.0, 0.0, 0.0, 0.0]], {},
    [1e300, 0.0, 0.0, 0.0], [10**400, 0, 0, 0], [NAN, 0.0, 0.0, 0.0], [True, False, False, False],
    [0.9, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [1.0, 0.1, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0],
]  # fmt: skip
NOT_A_TIME = [
    NAN, float("inf"), None, "1532402927647951", 2**64, 10**400, -1, -(2**70), 1532402927.647951, 1532402927647951000,
    True, [START_US], {},
]  # fmt: skip
NOT_A_SIZE = [
    [1.0, 2.0], [*FAR, 4.0], None, "big", ["1", "2", "3"], [1.0, None, 1.0], {}, [1e300, 1.0, 1.0], [2000.0, 1.0, 1.0],
    [0.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, NAN], DEEP,
]  # fmt: skip
NOT_A_NUMBER_OF_PIXELS = [None, "48", 48.5, NAN, [48], True, 10**30, -48, 0]
NOT_A_FILE = [
    None, "", 7, ["a.jpg"], {}, "a" * 5000, "a/" * 2500 + "b", "../outside.jpg", "samples/../../outside.jpg",
    "/etc/hostname", "C:\\images\\a.jpg", "samples/\0.jpg", "samples/\ud800.jpg", ".",
]  # fmt: skip
NOT_A_TOKEN = [None, 7, ["a"], {"a": 1}, "", True, "a" * 5000, "two\nlines"]


def k(fx: float, fy: float, cx: float = 24.0, cy: float = 13.0) -> list[list[float]]:
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


NO_PINHOLE = [
    None, {"fx": 30.0}, dict(enumerate(k(30.0, 30.0))), "K", [["30", "0", "24"], ["0", "30", "13"], ["0", "0", "1"]],
    [[None] * 3] * 3, DEEP, [], [[30.0, 0.0], [0.0, 30.0]], [[30.0, 0.0, 24.0], [0.0, 30.0], [0.0, 0.0, 1.0]],
]  # fmt: skip
SINGULAR = [
    k(30.0, 30.0, NAN), [[0.0] * 3, *k(30.0, 30.0)[1:]], k(30.0, 0.0), k(30.0, -30.0), [*k(30.0, 30.0)[:2], [0.0] * 3],
    [[30.0, 0.0, 24.0], [30.0, 0.0, 13.0], [0.0, 0.0, 1.0]], [[30.0, 30.0, 24.0], [30.0, 30.0, 13.0], [0.0, 0.0, 1.0]],
]  # fmt: skip
POSES = [("ego_pose", IMAGE), ("ego_pose", SWEEP), ("sample_annotation", BOX), ("calibrated_sensor", CAMERA)]
TIMED = [("sample", SAMPLE), ("sample_data", IMAGE), ("sample_data", SWEEP), ("sample_data", BETWEEN)]
NAMES = [
    ("scene", "scene 0001", "first_sample_token"), ("scene", "scene 0001", "log_token"),
    ("sample_data", IMAGE, "ego_pose_token"), ("sample_data", IMAGE, "calibrated_sensor_token"),
    ("sample_annotation", BOX, "instance_token"), ("instance", "0001 instance 1", "category_token"),
    ("calibrated_sensor", CAMERA, "sensor_token"), ("sensor", "CAM_FRONT", "channel"),
    ("category", "category vehicle.car", "name"),
]  # fmt: skip


def all_and_one(records: list[tuple], values: list) -> list[tuple]:
    """Every value for the first record, one of them for each of the others, which the same check reads."""
    return [(record, values[2:3] if i else values) for i, record in enumerate(records)]


MALFORMED = [
    *((*record, "translation", values, "its translation is") for record, values in all_and_one(POSES, NOT_A_POSITION)),
    *((*record, "rotation", values, "its rotation is") for record, values in all_and_one(POSES, NOT_A_ROTATION)),
    *((*record, "timestamp", values, ": its timestamp is .*microseconds")
      for record, values in all_and_one(TIMED, NOT_A_TIME)),
    *((*name, values, name[2]) for name, values in all_and_one(NAMES, NOT_A_TOKEN)),
    ("sample_annotation", BOX, "size", NOT_A_SIZE, r" \(instance 0001 instance 1\): its size is"),
    ("sample_annotation", BOX, "visibility_token", [4, ["4"], {}, True], ": its visibility_token is"),
    ("sample_data", IMAGE, "width", NOT_A_NUMBER_OF_PIXELS, ": its image size is"),
    ("sample_data", IMAGE, "height", [48.5, 0], ": its image size is"),
    *(("sample_data", token, "filename", values, ": its filename")
      for token, values in all_and_one([IMAGE, SWEEP], NOT_A_FILE)),
    ("sample_data", BETWEEN, "is_key_frame", ["False", "true", 0, 1, None, [], {}], ": its is_key_frame is .*true or"),
    ("scene", "scene 0001", "description", [7, ["text"], {}, "lone \ud800"], ": its description is"),
    ("calibrated_sensor", CAMERA, "camera_intrinsic", NO_PINHOLE, ": .*pinhole"),
    ("calibrated_sensor", CAMERA, "camera_intrinsic", SINGULAR, ": "),
    *(("calibrated_sensor", CAMERA, "camera_intrinsic", [matrix], said) for matrix, said in (
        (k(1e-300, 1e-300), "focal length is 1e-300 pixels"), (k(30.0, 4.7), "focal length is 4.7 pixels"),
        (k(961.0, 961.0), "focal length is 961 pixels"), (k(1e299, 1e299), r"focal length is 1e\+299 pixels"),
        (k(30.0, 30.0, 49.0), "principal point .49, 13. is outside"),
        (k(30.0, 30.0, 24.0, -1.0), "principal point .24, -1. is outside"),
        (k(30.0, 30.0, 800.0, 450.0), "outside its images of 48x27"),
    )),
    ("calibrated_sensor", CAMERA, "translation", [[1700.0, 0.0, 1500.0]], "metres"),  # a mount in millimetres
    ("calibrated_sensor", CAMERA, "readout_s", ["fast", -0.01, 17.0], ": its readout time"),
    ("calibrated_sensor", CAMERA, "readout_direction", ["sideways"], ": its readout direction"),
    ("calibrated_sensor", LIDAR, "beam_elevations", ["many", [[0.1], [0.2]], [-30.0, 10.0]], ": its beam elevations"),
    ("calibrated_sensor", LIDAR, "azimuth_steps", ["1085", 0], ": its azimuth steps"),
]  # fmt: skip


@pytest.mark.parametrize(("table", "token", "column", "values", "said"), MALFORMED)
def test_a_malformed_value_is_refused_naming_its_record(root, table, token, column, values, said):
    original = json.loads((root / f"v1.0-mini/{table}.json").read_text())
    for value in values:
        edit(root, table, lambda rows, value=value: row(rows, token).update({column: value}))
        message = refusal(root)
        assert re.search(f"{table} {token}.*{said}", message), value
        assert "token" in column or message.startswith(f"{table} {token}"), value
        edit(root, table, lambda _: original)


def scaled(root: Path, convert) -> None:
    for table in ("sample", "sample_data", "ego_pose"):
        edit(root, table, lambda rows: [{**it, "timestamp": convert(it["timestamp"])} for it in rows])


@pytest.mark.parametrize(
    "convert",
    [lambda t: t // 1_000_000, lambda t: t * 1e-6, lambda t: t // 1000, lambda t: t * 1000],
    ids=["whole seconds", "seconds", "milliseconds", "nanoseconds"],
)
def test_times_in_another_unit_are_refused_with_the_unit_that_is_wanted(root, convert):
    scaled(root, convert)
    assert "microseconds" in refusal(root)


def test_times_that_start_at_0_are_accepted(root):
    scaled(root, lambda time: time - START_US + 40_000)
    assert extracted(root).key_frame_timestamps.tolist() == [40_000, 540_000, 1_040_000]


def test_a_recording_far_from_its_key_frame_is_refused_naming_it(root):
    """All recordings by another clock."""
    edit(root, "sample_data", lambda rows: [{**it, "timestamp": it["timestamp"] + 3_000_000} for it in rows])
    message = refusal(root)
    assert message.startswith("sample_data 0001 CAM_FRONT 0") and "from that of its sample" in message


def test_a_description_may_be_missing_or_long_and_have_lines(root):
    for description in ("Rain.\nNight. " * 100, None):
        edit(root, "scene", lambda rows, text=description: rows[0].update(description=text))
        assert extracted(root).description == (description or "")
    edit(root, "scene", lambda rows: rows[0].pop("description") and None)
    assert extracted(root).description == ""


COLUMNS = [
    ("scene", "name"), ("sample", "timestamp"), ("sample_data", "is_key_frame"), ("sample_data", "filename"),
    ("ego_pose", "rotation"), ("calibrated_sensor", "camera_intrinsic"), ("sample_annotation", "size"),
    ("instance", "category_token"), ("sensor", "channel"), ("category", "name"), ("map", "log_tokens"),
]  # fmt: skip


def test_rows_without_a_column_are_refused_naming_table_and_token(root):
    for table, column in COLUMNS:
        original = json.loads((root / f"v1.0-mini/{table}.json").read_text())
        edit(root, table, lambda rows, column=column: [rows[0].pop(column), rows][1])
        assert f"{table} {original[0]['token']}" in refusal(root), column
        edit(root, table, lambda _, original=original: original)


@pytest.mark.parametrize(
    ("table", "content"),
    [("scene", "{}"), ("scene", "7"), ("sample_data", ""), ("sample_data", '[{"token": '), ("sensor", "[null]"),
     ("map", "[" * 200_000), ("map", "\ufeff[]"), ("sample_data", "[" + "9" * 5000 + "]")],
    ids=lambda content: content[:12] or "empty",
)  # fmt: skip
def test_a_table_that_is_no_list_of_rows_is_refused_with_its_folder(root, table, content):
    (root / f"v1.0-mini/{table}.json").write_text(content)
    message = refusal(root)
    assert f"nuScenes v1.0-mini in {root} cannot be read" in message and table in message


def test_a_row_nested_too_deeply_and_a_malformed_table_of_sensors_are_refused_with_the_table(root):
    for content in ("[1]", "[{}]", "[" * 200_000, '[{"modality": "camera"}]'):
        (root / "v1.0-mini/sensor.json").write_text(content)
        with pytest.raises(DatasetError, match=r"sensor\.json cannot be read"):
            camera_names(root, "v1.0-mini")
    path = root / "v1.0-mini/sample.json"
    path.write_text(path.read_text().replace("{", '{"note": ' + "[" * 200_000 + "]" * 200_000 + ",", 1))
    assert "sample.json is nested too deeply" in refusal(root)


FIRST_IMAGE, BEFORE = "0001 CAM_FRONT 1", START_US - 10 * KEY_FRAME_US
CHANGED = [
    ("sample", SAMPLE, {"next": SAMPLE}, f"sample {SAMPLE}: its next is {SAMPLE}, which comes"),
    ("sample", SAMPLE, {"next": "0001 sample 0"}, f"sample {SAMPLE}: its next is 0001 sample 0, which comes before"),
    ("sample", SAMPLE, {"timestamp": START_US}, f"sample {SAMPLE}"),
    ("sample", SAMPLE, {"timestamp": START_US - KEY_FRAME_US}, f"sample {SAMPLE}"),
    ("sample", SAMPLE, {"next": "nowhere"}, "nowhere"),
    ("sample", SAMPLE, {"next": ""}, "sample 0001 sample 2: it is in the scene, but"),
    ("sample_data", BETWEEN, {"next": IMAGE}, f"sample_data {IMAGE}"),
    ("sample_data", BETWEEN, {"next": BETWEEN}, f"sample_data {BETWEEN}"),
    ("sample_data", IMAGE, {"timestamp": BEFORE}, f"sample_data {IMAGE}"),
    ("sample_data", SWEEP, {"timestamp": BEFORE}, f"sample_data {SWEEP}"),
    ("sample_data", BETWEEN, {"timestamp": START_US}, f"sample_data {BETWEEN}"),
    ("sample_data", BETWEEN, {"next": ""}, f"sample_data {BETWEEN}"),
    ("sample_data", IMAGE, {"ego_pose_token": "nowhere"}, "nowhere"),
    ("sample_data", IMAGE, {"next": "nowhere"}, "nowhere"),
    ("sample_data", FIRST_IMAGE, {"next": BETWEEN}, f"sample_data {IMAGE}: the chain of CAM_FRONT leaves it out"),
    ("sample_data", FIRST_IMAGE, {"next": SWEEP}, f"{SWEEP}: it stands in the chain of another sensor"),
    ("sample_data", BETWEEN, {"is_key_frame": True},
     f"sample_data {BETWEEN}: its sample 0001 sample 1 has another recording"),
]  # fmt: skip
"""Otherwise a drive would be shorter, or another one, without a word."""


@pytest.mark.parametrize(("table", "token", "change", "said"), CHANGED)
def test_times_and_links_that_cannot_be_are_refused_naming_the_record(root, table, token, change, said):
    edit(root, table, lambda rows: row(rows, token).update(change))
    assert said in refusal(root)


AGAIN = "two records have this token"
REPEATED = [
    ("ego_pose", IMAGE, {}, f"ego_pose {IMAGE}: {AGAIN}"), ("sample_data", IMAGE, {}, f"sample_data {IMAGE}: {AGAIN}"),
    ("instance", "0001 instance 1", {}, f"instance 0001 instance 1: {AGAIN}"),
    ("category", "category vehicle.car", {}, f"category category vehicle.car: {AGAIN}"),
    ("scene", "scene 0001", {"token": "again"}, "scene again: its name scene-0001 is that of another scene"),
    ("sample_annotation", BOX, {"token": "again"},
     "sample_annotation again: instance 0001 instance 1 has another box in sample 0001 sample 1"),
]  # fmt: skip


@pytest.mark.parametrize(("table", "token", "change", "said"), REPEATED)
def test_a_row_that_repeats_another_is_refused_naming_it(root, table, token, change, said):
    edit(root, table, lambda rows: [*rows, {**row(rows, token), **change}])
    assert said in refusal(root)


def test_a_damaged_row_of_a_sensor_that_is_not_read_refuses_no_drive(root):
    """Radars and cameras that the config does not name may have any image size and calibration."""
    edit(root, "sensor", lambda rows: [*rows, {"token": "R", "channel": "RADAR_FRONT", "modality": "radar"}])
    radar = {"translation": None, "rotation": None, "camera_intrinsic": None}
    edit(root, "calibrated_sensor", lambda rows: [*rows, {"token": "calibrated R", "sensor_token": "R", **radar}])
    data = {"token": "radar 0", "calibrated_sensor_token": "calibrated R", "width": None, "height": None, "next": ""}
    edit(root, "sample_data", lambda rows: [*rows, {**row(rows, IMAGE), **data, "filename": None}])
    assert len(extracted(root).frames) == 5


@pytest.mark.parametrize("speed", [110.0, 130.0])
def test_tracks_that_jump_are_warned_of_with_id_and_times(root, caplog, speed):
    """A parked truck is moved once, at the second key frame."""

    def jump(rows: list[dict]) -> None:
        for token in (BOX, "0001 annotation 1 2"):
            row(rows, token)["translation"][0] += speed * KEY_FRAME_US * 1e-6

    edit(root, "sample_annotation", jump)
    with caplog.at_level(logging.WARNING):
        assert len(extracted(root).tracks) == 4
    found = [it.getMessage() for it in caplog.records if "jumps" in it.getMessage()]
    assert len(found) == (1 if speed > 120.0 else 0)
    for part in ("track 0001 instance 1 (vehicle.truck) jumps", "65 m within 0.50 s", f"{START_US + KEY_FRAME_US}"):
        assert not found or part in found[0]


def test_an_ego_vehicle_that_jumps_is_warned_of(root, caplog):
    edit(root, "ego_pose", lambda rows: row(rows, IMAGE).update(translation=[900.0, 1100.0, 0.0]))
    with caplog.at_level(logging.WARNING):
        extracted(root)
    assert sum("the ego vehicle jumps, " in it.getMessage() for it in caplog.records) == 1


def test_of_many_tracks_that_jump_ten_are_named(small_root):
    scene = extracted(small_root)
    poses = scene.tracks[0].object_to_world.copy()
    poses[1, 0, 3] += 1000.0
    jumping = dataclasses.replace(scene.tracks[0], object_to_world=poses)
    found = jumps(dataclasses.replace(scene, tracks=(jumping,) * 13))
    assert len(found) == 11 and found[-1] == "3 more tracks jump"


@pytest.mark.parametrize("table", ["sample_annotation", "sample_data"])
def test_a_row_of_a_sample_that_exists_nowhere_is_refused_with_its_token(root, tmp_path, table):
    """Rows are split by the scene of their sample; this one would belong to none."""
    token = {"sample_annotation": BOX, "sample_data": BETWEEN}[table]
    edit(root, table, lambda rows: row(rows, token).update(sample_token="nowhere"))
    with pytest.raises(DatasetError, match=rf"sample nowhere is referred to by {table} {token}, but not in the tables"):
        index_tables(root, "v1.0-mini", ["0001"], tmp_path / "rows")
