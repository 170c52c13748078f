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
from drivesplat.readers.nuscenes.layout import TABLES, camera_names
from drivesplat.readers.nuscenes.scene_tables import index_tables

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


def test_the_undamaged_drive_is_read(root):
    assert len(extracted(root).frames) == 5


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
MALFORMED = [
    *((*record, "translation", NOT_A_POSITION, "its translation is") for record in POSES),
    *((*record, "rotation", NOT_A_ROTATION, "its rotation is") for record in POSES),
    *((*record, "timestamp", NOT_A_TIME, ": its timestamp is .*microseconds") for record in TIMED),
    *((*name, NOT_A_TOKEN, name[2]) for name in NAMES),
    ("sample_annotation", BOX, "size", NOT_A_SIZE, r" \(instance 0001 instance 1\): its size is"),
    ("sample_annotation", BOX, "visibility_token", [4, ["4"], {}, True], ": its visibility_token is"),
    *(("sample_data", IMAGE, name, NOT_A_NUMBER_OF_PIXELS, ": its image size is") for name in ("width", "height")),
    *(("sample_data", token, "filename", NOT_A_FILE, ": its filename") for token in (IMAGE, SWEEP)),
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


def test_a_malformed_direction_of_the_readout_is_refused(root):
    change = {"readout_s": 0.02, "readout_direction": "sideways"}
    edit(root, "calibrated_sensor", lambda rows: row(rows, CAMERA).update(change))
    assert refusal(root).startswith(f"calibrated_sensor {CAMERA}: its readout direction")


@pytest.mark.parametrize("value", [4.9, 960.0])
def test_focal_lengths_within_the_range_are_accepted(root, value):
    edit(root, "calibrated_sensor", lambda rows: row(rows, CAMERA).update(camera_intrinsic=k(value, value, 0.0, 27.0)))
    assert extracted(root).frames[0].intrinsics[0, 0] == value


def scaled(root: Path, convert) -> None:
    for table in ("sample", "sample_data", "ego_pose"):
        edit(root, table, lambda rows: [{**it, "timestamp": convert(it["timestamp"])} for it in rows])


@pytest.mark.parametrize(
    "convert",
    [lambda t: t // 1_000_000, lambda t: t * 1e-6, lambda t: t // 1000, lambda t: t * 1000, lambda t: f"{t}"],
    ids=["whole seconds", "seconds", "milliseconds", "nanoseconds", "text"],
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


@pytest.mark.parametrize("value", NOT_A_TOKEN[:4], ids=lambda value: repr(value)[:20])
@pytest.mark.parametrize("table", [table for table in TABLES if table not in ("attribute", "log", "map")])
def test_a_row_with_a_malformed_token_is_refused_naming_its_table(root, table, value):
    edit(root, table, lambda rows: rows[0].update(token=value))
    assert table in refusal(root)


@pytest.mark.parametrize("value", ["absent", None])
def test_a_scene_without_a_description_has_an_empty_one(root, value):
    edit(root, "scene", lambda rows: without_description(rows, value))
    assert extracted(root).description == ""


def without_description(rows: list[dict], value: str | None) -> None:
    rows[0].pop("description") if value else rows[0].update(description=None)


def test_a_description_may_be_long_and_have_lines(root):
    edit(root, "scene", lambda rows: rows[0].update(description="Rain.\nNight. " * 100))
    assert extracted(root).description == "Rain.\nNight. " * 100


COLUMNS = [
    ("scene", "name"), ("scene", "log_token"), ("scene", "first_sample_token"), ("sample", "next"),
    ("sample", "timestamp"), ("sample", "scene_token"), ("sample_data", "next"), ("sample_data", "sample_token"),
    ("sample_data", "is_key_frame"), ("sample_data", "filename"), ("sample_data", "width"), ("ego_pose", "rotation"),
    ("ego_pose", "translation"), ("calibrated_sensor", "camera_intrinsic"), ("calibrated_sensor", "rotation"),
    ("sample_annotation", "size"), ("sample_annotation", "translation"), ("sample_annotation", "sample_token"),
    ("instance", "category_token"), ("sensor", "channel"), ("category", "name"), ("map", "log_tokens"),
    ("map", "filename"),
]  # fmt: skip


@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_rows_without_a_column_are_refused_naming_table_and_token(root, table, column):
    token = json.loads((root / f"v1.0-mini/{table}.json").read_text())[0]["token"]
    edit(root, table, lambda rows: [rows[0].pop(column), rows][1])
    assert f"{table} {token}" in refusal(root)


@pytest.mark.parametrize("table", ["scene", "sample_data", "sensor", "map"])
@pytest.mark.parametrize(
    "content",
    ["{}", '"table"', "7", "null", "", "[1, 2]", '["a"]', "[null]", "[[]]", "[", '[{"token": ', "nothing",
     "[" * 200_000, '[{"token": ' + "[" * 200_000, "[" + "9" * 5000 + "]", "\ufeff[]"],
    ids=lambda content: content[:12] or "empty",
)  # fmt: skip
def test_a_table_that_is_no_list_of_rows_is_refused_with_its_folder(root, table, content):
    (root / f"v1.0-mini/{table}.json").write_text(content)
    message = refusal(root)
    assert f"nuScenes v1.0-mini in {root} cannot be read" in message and table in message


@pytest.mark.parametrize("content", ["{}", '"table"', "[1]", "[{}]", "[" * 200_000, '[{"modality": "camera"}]'])
def test_cameras_of_a_malformed_table_are_refused_with_the_table(root, content):
    (root / "v1.0-mini/sensor.json").write_text(content)
    if content == "{}":
        assert camera_names(root, "v1.0-mini") == []
        return
    with pytest.raises(DatasetError, match=r"sensor\.json cannot be read"):
        camera_names(root, "v1.0-mini")


def test_a_row_nested_too_deeply_in_an_unused_column_is_refused(root):
    edit(root, "sample", lambda rows: rows[0].update(note="deep"))
    path = root / "v1.0-mini/sample.json"
    path.write_text(path.read_text().replace('"deep"', "[" * 200_000 + "]" * 200_000))
    assert "sample.json is nested too deeply" in refusal(root)


@pytest.mark.parametrize("back_to", ["0001 sample 0", "0001 sample 1"])
def test_a_circle_of_samples_is_refused_naming_where_it_closes(root, back_to):
    edit(root, "sample", lambda rows: row(rows, SAMPLE).update(next=back_to))
    assert refusal(root).startswith(f"sample {SAMPLE}: its next is {back_to}, which comes before it")


@pytest.mark.parametrize("back_to", ["0001 CAM_FRONT 0", "0001 CAM_FRONT 2", BETWEEN])
def test_a_circle_of_images_is_refused_naming_a_record_of_it(root, back_to):
    edit(root, "sample_data", lambda rows: row(rows, BETWEEN).update(next=back_to))
    assert refusal(root).startswith(f"sample_data {back_to}")


@pytest.mark.parametrize("delay", [-KEY_FRAME_US, -2 * KEY_FRAME_US])
def test_key_frames_out_of_order_are_refused_naming_the_sample(root, delay):
    edit(root, "sample", lambda rows: row(rows, SAMPLE).update(timestamp=START_US + KEY_FRAME_US + delay))
    assert f"sample {SAMPLE}" in refusal(root)


@pytest.mark.parametrize("sweeps", [False, True])
@pytest.mark.parametrize("token", [IMAGE, SWEEP])
def test_a_sensors_records_out_of_order_are_refused_naming_one(root, token, sweeps):
    edit(root, "sample_data", lambda rows: row(rows, token).update(timestamp=START_US - 10 * KEY_FRAME_US))
    assert f"sample_data {token}" in refusal(root, sweeps=sweeps)


@pytest.mark.parametrize("change", [{"timestamp": START_US}, {"next": ""}])
def test_an_image_between_key_frames_out_of_order_or_at_the_end_of_a_chain_is_refused_naming_it(root, change):
    edit(root, "sample_data", lambda rows: row(rows, BETWEEN).update(change))
    assert f"sample_data {BETWEEN}" in refusal(root)


@pytest.mark.parametrize(
    ("table", "token", "key"),
    [("sample_data", IMAGE, "ego_pose_token"), ("sample_data", IMAGE, "next"), ("sample", SAMPLE, "next")],
)
def test_a_token_without_a_row_is_refused_naming_it(root, table, token, key):
    edit(root, table, lambda rows: row(rows, token).update({key: "nowhere"}))
    assert "nowhere" in refusal(root)


def test_samples_outside_of_the_chain_are_refused_naming_one(root):
    """Otherwise the drive would be shorter without a word."""
    edit(root, "sample", lambda rows: row(rows, SAMPLE).update(next=""))
    assert refusal(root).startswith("sample 0001 sample 2: it is in the scene, but")


def test_key_frames_outside_of_a_sensors_chain_are_refused_naming_one(root):
    edit(root, "sample_data", lambda rows: row(rows, "0001 CAM_FRONT 1").update(next=BETWEEN))
    assert refusal(root).startswith(f"sample_data {IMAGE}: the chain of CAM_FRONT leaves it out")


def test_a_chain_that_leads_to_another_sensor_is_refused_naming_where(root):
    edit(root, "sample_data", lambda rows: row(rows, "0001 CAM_FRONT 1").update(next=SWEEP))
    assert refusal(root).startswith(f"sample_data {SWEEP}: it stands in the chain of another sensor")


@pytest.mark.parametrize(
    ("table", "token"),
    [
        ("ego_pose", IMAGE),
        ("sample_data", IMAGE),
        ("sample", SAMPLE),
        ("sample_annotation", BOX),
        ("instance", "0001 instance 1"),
        ("calibrated_sensor", CAMERA),
        ("sensor", "CAM_FRONT"),
        ("category", "category vehicle.car"),
        ("log", "log"),
    ],
)
def test_two_rows_with_one_token_are_refused_naming_it(root, table, token):
    edit(root, table, lambda rows: [*rows, row(rows, token)])
    assert refusal(root).startswith(f"{table} {token}: two records have this token")


def test_two_scenes_of_one_name_are_refused_naming_it(root):
    edit(root, "scene", lambda rows: [*rows, {**rows[0], "token": "again"}])
    assert "scene again: its name scene-0001 is that of another scene" in refusal(root)


def test_two_boxes_of_one_instance_in_a_sample_are_refused_naming_the_second(root):
    edit(root, "sample_annotation", lambda rows: [*rows, {**row(rows, BOX), "token": "again"}])
    message = refusal(root)
    assert message.startswith(
        "sample_annotation again: instance 0001 instance 1 has another box in sample 0001 sample 1"
    )


def test_two_key_frames_of_one_sensor_in_a_sample_are_refused_naming_the_second(root):
    edit(root, "sample_data", lambda rows: row(rows, BETWEEN).update(is_key_frame=True))
    assert refusal(root).startswith(f"sample_data {BETWEEN}: its sample 0001 sample 1 has another recording")


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
    apart = speed * KEY_FRAME_US * 1e-6
    edit(root, "sample_annotation", lambda rows: jump(rows, apart))
    with caplog.at_level(logging.WARNING):
        assert len(extracted(root).tracks) == 4
    found = [it.getMessage() for it in caplog.records if "jumps" in it.getMessage()]
    assert len(found) == (1 if speed > 120.0 else 0)
    for part in ("track 0001 instance 1 (vehicle.truck) jumps", "65 m within 0.50 s", f"{START_US + KEY_FRAME_US}"):
        assert not found or part in found[0]


def jump(rows: list[dict], apart: float) -> None:
    """Moves a parked truck once, at the second key frame."""
    for it in rows:
        if it["token"] in (BOX, "0001 annotation 1 2"):
            it["translation"][0] += apart


def test_of_many_tracks_that_jump_ten_are_named(small_root):
    scene = extracted(small_root)
    poses = scene.tracks[0].object_to_world.copy()
    poses[1, 0, 3] += 1000.0
    jumping = dataclasses.replace(scene.tracks[0], object_to_world=poses)
    assert len(jumps(dataclasses.replace(scene, tracks=(jumping,) * 10))) == 10
    found = jumps(dataclasses.replace(scene, tracks=(jumping,) * 13))
    assert len(found) == 11 and found[-1] == "3 more tracks jump"


def test_an_ego_vehicle_that_jumps_is_warned_of(root, caplog):
    edit(root, "ego_pose", lambda rows: row(rows, IMAGE).update(translation=[900.0, 1100.0, 0.0]))
    with caplog.at_level(logging.WARNING):
        extracted(root)
    assert sum("the ego vehicle jumps, " in it.getMessage() for it in caplog.records) == 1


def test_an_undamaged_drive_jumps_nowhere(root, caplog):
    with caplog.at_level(logging.WARNING):
        extracted(root)
    assert "jumps" not in caplog.text


@pytest.mark.parametrize("table", ["sample_annotation", "sample_data"])
def test_a_row_of_a_sample_that_exists_nowhere_is_refused_with_its_token(root, tmp_path, table):
    """Rows are split by the scene of their sample; this one would belong to none."""
    token = {"sample_annotation": BOX, "sample_data": BETWEEN}[table]
    edit(root, table, lambda rows: row(rows, token).update(sample_token="nowhere"))
    with pytest.raises(DatasetError, match=rf"sample nowhere is referred to by {table} {token}, but not in the tables"):
        index_tables(root, "v1.0-mini", ["0001"], tmp_path / "rows")
