"""Segments of v2: a parquet file for each component, read in small batches: memory does not grow with the length of a
segment.

Columns are those of src/waymo_open_dataset/v2/perception in github.com/waymo-research/waymo-open-dataset. Numbers of
sensors and timestamps may be texts, and floats of single precision.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from drivesplat.errors import DatasetError
from drivesplat.readers.record_names import shown
from drivesplat.readers.waymo.layout import SegmentFiles
from drivesplat.readers.waymo.names import SEGMENTATION, TOP
from drivesplat.readers.waymo.segment import (
    BoxRecord,
    CameraRecord,
    ChosenRecordings,
    ImageFile,
    ImageRecord,
    LaserRecord,
    PanopticLabel,
    RangeImage,
    Segment,
    cells,
    frame_name,
    sweep_name,
)

TIME, CAMERA, LASER, OBJECT = (
    f"key.{name}" for name in ("frame_timestamp_micros", "camera_name", "laser_name", "laser_object_id")
)
NUMBERS = (TIME, CAMERA, LASER, ".type", ".rolling_shutter_direction")
"""Ends of names of columns that hold whole numbers."""
INTRINSIC = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
RANGES, POSES = "[LiDARComponent].range_image_return1", "[LiDARPoseComponent].range_image_return1"
IMAGE = "[CameraImageComponent].image"
LABEL = "[CameraSegmentationLabelComponent].panoptic_label"
LARGE_ROWS = 4
"""Images and range images that are read at once."""
Key = tuple[int, int]
SEGMENT = "key.segment_context_name"
TEXTS = (SEGMENT, "key.laser_object_id")
LISTS, BYTES = (".transform", ".values", ".shape"), (".image", ".panoptic_label")
"""Ends of names of columns that hold lists of numbers, or bytes."""
BUFFER = 1 << 20
"""Bytes that are read of a column at once: less than its whole chunk, which may hold all images of a segment."""


def read_segment(files: SegmentFiles) -> Segment:
    """The segment of these files, without its images and the values of its range images."""
    read = partial(_rows, files)
    segment = _frames_and_lasers(files)
    at = "[CameraCalibrationComponent]."
    others = [f"{at}{name}" for name in ("extrinsic.transform", "width", "height", "rolling_shutter_direction")]
    for row in read("camera_calibration", CAMERA, *(f"{at}intrinsic.{name}" for name in INTRINSIC), *others):
        intrinsic = [row[f"{at}intrinsic.{name}"] for name in INTRINSIC]
        segment.cameras[row[CAMERA]] = CameraRecord(row[CAMERA], intrinsic, *(row[name] for name in others))
    at, times = "[CameraImageComponent].", ("shutter", "camera_trigger_time", "camera_readout_done_time")
    columns = [f"{at}{name}" for name in ("pose.transform", "pose_timestamp")]
    columns += [f"{at}rolling_shutter_params.{name}" for name in times]
    for row in read("camera_image", TIME, CAMERA, *columns):
        segment.images.append(ImageRecord(row[TIME], row[CAMERA], *(row[name] for name in columns)))
    at = "[LiDARBoxComponent]."
    center, size = ([f"{at}box.{part}.{axis}" for axis in "xyz"] for part in ("center", "size"))
    kind, heading = f"{at}type", f"{at}box.heading"
    for row in read("lidar_box", TIME, OBJECT, *center, *size, heading, kind):
        values = ([row[name] for name in names] for names in (center, size))
        segment.boxes.append(BoxRecord(row[TIME], row[OBJECT], row[kind], *values, row[heading]))
    for row in read("lidar", TIME, LASER, f"{RANGES}.shape"):
        shape = row[f"{RANGES}.shape"]
        if shape:
            segment.sweeps.append((row[TIME], row[LASER]))
            if len(shape) == 3 and all(isinstance(length, int) for length in shape):
                segment.shapes.setdefault(row[LASER], (shape[0], shape[1]))
    return segment


def read_recordings(files: SegmentFiles, wanted: ChosenRecordings) -> Iterator[ImageFile | PanopticLabel | RangeImage]:
    """The wanted images, with their labels, and range images, one at a time."""
    path = files.files["camera_image"]
    for row in rows(path, [TIME, CAMERA, IMAGE], files.name, LARGE_ROWS):
        time, camera = whole(row[TIME], path, TIME), whole(row[CAMERA], path, CAMERA)
        if (time, camera) in wanted.images:
            yield ImageFile(time, camera, row[IMAGE] if isinstance(row[IMAGE], bytes) else b"")
    if SEGMENTATION in files.files:
        path, divisor = files.files[SEGMENTATION], f"{LABEL}_divisor"
        for row in rows(path, [TIME, CAMERA, LABEL, divisor], files.name, LARGE_ROWS):
            time, camera = whole(row[TIME], path, TIME), whole(row[CAMERA], path, CAMERA)
            if (time, camera) in wanted.images and isinstance(row[LABEL], bytes):
                yield PanopticLabel(time, camera, row[LABEL], whole(row[divisor], path, divisor))
    yield from _range_images(files, wanted)


def _frames_and_lasers(files: SegmentFiles) -> Segment:
    segment = Segment(files.name, files.version)
    pose = "[VehiclePoseComponent].world_from_vehicle.transform"
    for row in _rows(files, "vehicle_pose", TIME, pose):
        if row[TIME] in segment.frames:
            raise DatasetError(f"{frame_name(row[TIME])}: {files.files['vehicle_pose']} has it twice")
        segment.frames[row[TIME]] = row[pose]
    at = "[LiDARCalibrationComponent]."
    columns = [f"{at}beam_inclination.{name}" for name in ("values", "min", "max")] + [f"{at}extrinsic.transform"]
    for row in _rows(files, "lidar_calibration", LASER, *columns):
        inclinations, lowest, highest, extrinsic = (row[name] for name in columns)
        segment.lasers[row[LASER]] = LaserRecord(row[LASER], inclinations or [], lowest, highest, extrinsic)
    return segment


def _rows(files: SegmentFiles, component: str, *columns: str) -> Iterator[dict[str, Any]]:
    """Rows of a component of a segment, with whole numbers in the columns NUMBERS."""
    path, numbers = files.files[component], [column for column in columns if column.endswith(NUMBERS)]
    for row in rows(path, columns, files.name):
        yield row | {column: whole(row[column], path, column) for column in numbers}


def _range_images(files: SegmentFiles, wanted: ChosenRecordings) -> Iterator[RangeImage]:
    """The range images, the TOP laser's with the poses of its pixels. Both files are read side by side; where they
    have another order, poses wait for their range images."""
    if not wanted.sweeps:
        return
    segment = _frames_and_lasers(files)
    poses, waiting = _matrices(files, "lidar_pose", POSES, 6, wanted), dict[Key, np.ndarray]()
    for key, values in _matrices(files, "lidar", RANGES, 4, wanted):
        if key[1] == TOP:
            while key not in waiting:
                of_another = next(poses, None)
                if of_another is None:
                    name, path = sweep_name(key[1], key[0]), files.files["lidar_pose"]
                    raise DatasetError(f"{name}: {path} has no poses of its pixels; download it again")
                waiting[of_another[0]] = of_another[1]
        pixels = waiting.pop(key) if key[1] == TOP else None
        yield RangeImage(key[0], segment.laser(key[1]), segment.frames[key[0]], values, pixels)


def _matrices(
    files: SegmentFiles, component: str, column: str, channels: int, wanted: ChosenRecordings
) -> Iterator[tuple[Key, np.ndarray]]:
    """The wanted range images of a component by time and laser."""
    path = files.files[component]
    names = [TIME, LASER, f"{column}.values", f"{column}.shape"]
    for batch in batches(path, names, files.name, LARGE_ROWS):
        times, lasers, values, shapes = batch.columns
        for i in range(len(batch)):
            key = whole(times[i].as_py(), path, TIME), whole(lasers[i].as_py(), path, LASER)
            if key in wanted.sweeps:
                inside, numbers = getattr(values[i], "values", None), np.zeros(0)
                with np.errstate(over="ignore"), suppress(TypeError, ValueError):  # it may be no list of numbers
                    numbers = numbers if inside is None else inside.to_numpy(zero_copy_only=False).astype(np.float32)
                yield key, cells(numbers, shapes[i].as_py() or (), channels, sweep_name(key[1], key[0]))


def rows(path: Path, columns: Sequence[str], segment: str, batch: int = 256) -> Iterator[dict[str, Any]]:
    """The rows of a file, with these columns by name: numbers and texts as Python has them, lists as lists, binary
    values as bytes.

    Raises DatasetError naming the file where it is damaged, lacks a column, or holds another segment.
    """
    for found in batches(path, columns, segment, batch):
        values = [column.to_pylist() for column in found.columns]
        yield from (dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True))


def batches(path: Path, columns: Sequence[str], segment: str, batch: int) -> Iterator[pa.RecordBatch]:
    """The same, as batches of at most `batch` rows with the columns in the given order."""
    wanted = [SEGMENT, *columns]
    try:
        with pq.ParquetFile(path, buffer_size=BUFFER, pre_buffer=False, page_checksum_verification=True) as file:
            absent = [name for name in wanted if name not in file.schema_arrow.names]
            if absent:
                raise DatasetError(f"{path} has no column {absent[0]}; download it again")
            wrong = next((name for name in wanted if not _fits(name, file.schema_arrow.field(name).type)), None)
            if wrong:
                kind = file.schema_arrow.field(wrong).type
                raise DatasetError(f"{path}: its column {wrong} is of type {kind}; download it again")
            for found in file.iter_batches(batch_size=batch, columns=wanted, use_threads=False):
                named = set(found.column(SEGMENT).to_pylist())
                if named - {segment}:
                    raise DatasetError(f"{path} holds segment {shown((named - {segment}).pop())}, not {segment}")
                yield found.select(list(columns))
    except (pa.ArrowException, OSError, OverflowError, UnicodeDecodeError, KeyError) as error:
        reason = "".join(c if c.isprintable() else " " for c in str(error))
        reason = " ".join(reason.split())[:200]
        raise DatasetError(f"{path} cannot be read ({reason}); download it again") from error


def _fits(name: str, kind: pa.DataType) -> bool:
    """Whether a column's type can hold its values: lists of numbers, bytes, texts, or numbers, of keys also as text."""
    is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_dictionary(kind)
    if name in TEXTS:
        return is_text or pa.types.is_null(kind)
    if name.endswith(BYTES):
        return pa.types.is_binary(kind) or pa.types.is_large_binary(kind)
    if name.endswith(LISTS):
        is_list = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
        return pa.types.is_null(kind) or (is_list and _is_number(kind.value_type))
    return _is_number(kind) or (is_text and name.startswith("key."))


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind)


def whole(value: Any, path: Path, column: str) -> int:
    """A whole number, which may be text. Raises DatasetError naming the file and the column for anything else."""
    try:
        if isinstance(value, bool | float) and value != int(value):
            raise ValueError
        return int(value)
    except (OverflowError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: a {column} is {shown(value)}; it must be a whole number") from error
