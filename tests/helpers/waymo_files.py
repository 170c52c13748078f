"""Writes a drive in Waymo's formats: v2, a parquet file for each component, and v1, a TFRecord file of `Frame`
messages, encoded here by hand from the field numbers of the published dataset.proto and label.proto."""

import struct
import zlib
from collections.abc import Iterable
from pathlib import Path

import google_crc32c
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from helpers.waymo_drive import READOUT_S, SHUTTER_S, Drive, ImageRecording, LabelRecording, RangeRecording

Row = dict[str, object]
NUMBERS = ("key.frame_timestamp_micros", "key.camera_name", "key.laser_name")


def write_v2(root: Path, drive: Drive, single: bool = False, text_keys: bool = False, rows_per_group: int = 3) -> Path:
    """Writes the components below `root`; `single`: floats of single precision; `text_keys`: keys as text."""
    for component, rows in components(drive).items():
        if component == "camera_segmentation" and not rows:  # which most segments lack
            continue
        path = root / component / f"{drive.name}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        if text_keys:
            rows = [{name: str(value) if name in NUMBERS else value for name, value in row.items()} for row in rows]
        table = pa.Table.from_pylist(rows, schema=_schema(component, single, text_keys))
        pq.write_table(table, path, row_group_size=rows_per_group, compression="snappy")
    return root


def components(drive: Drive) -> dict[str, list[Row]]:
    """The rows of all components."""
    key = {"key.segment_context_name": drive.name}
    return {
        "vehicle_pose": [
            {**_at(key, time), "[VehiclePoseComponent].world_from_vehicle.transform": pose.ravel().tolist()}
            for time, pose in drive.frames.items()
        ],
        "camera_calibration": [_camera_row(key, camera) for camera in drive.cameras],
        "lidar_calibration": [_laser_row(key, laser) for laser in drive.lasers],
        "camera_image": [_image_row(key, image) for image in drive.images],
        "lidar": [
            {**_at(key, sweep.frame), "key.laser_name": sweep.laser, **_matrix("LiDARComponent", sweep.values)}
            for sweep in drive.sweeps
        ],
        "lidar_pose": [
            {**_at(key, sweep.frame), "key.laser_name": sweep.laser, **_matrix("LiDARPoseComponent", sweep.poses)}
            for sweep in drive.sweeps
            if sweep.poses is not None
        ],
        "lidar_box": [_box_row(key, box) for box in drive.boxes],
        "camera_segmentation": [_label_row(key, label) for label in drive.labels],
    }


def _at(key: Row, time: int) -> Row:
    return {**key, "key.frame_timestamp_micros": time}


def _camera_row(key: Row, camera) -> Row:
    at = "[CameraCalibrationComponent]"
    names = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
    return {
        **key,
        "key.camera_name": camera.number,
        **{f"{at}.intrinsic.{name}": value for name, value in zip(names, camera.intrinsic, strict=True)},
        f"{at}.extrinsic.transform": camera.extrinsic.ravel().tolist(),
        f"{at}.width": camera.width,
        f"{at}.height": camera.height,
        f"{at}.rolling_shutter_direction": camera.direction,
    }


def _laser_row(key: Row, laser) -> Row:
    at = "[LiDARCalibrationComponent]"
    return {
        **key,
        "key.laser_name": laser.number,
        f"{at}.extrinsic.transform": laser.extrinsic.ravel().tolist(),
        f"{at}.beam_inclination.min": laser.lowest,
        f"{at}.beam_inclination.max": laser.highest,
        f"{at}.beam_inclination.values": None if laser.inclinations is None else laser.inclinations.tolist(),
    }


def _times(image: ImageRecording) -> tuple[float, float, float]:
    """Shutter, trigger and end of the readout of an image whose middle line is exposed at its time."""
    trigger = image.seconds - READOUT_S / 2 - SHUTTER_S / 2
    return SHUTTER_S, trigger, trigger + SHUTTER_S + READOUT_S


def _image_row(key: Row, image: ImageRecording) -> Row:
    at, (shutter, trigger, done) = "[CameraImageComponent]", _times(image)
    return {
        **_at(key, image.frame),
        "key.camera_name": image.camera,
        f"{at}.image": image.content,
        f"{at}.pose.transform": image.pose.ravel().tolist(),
        f"{at}.pose_timestamp": image.seconds,
        f"{at}.rolling_shutter_params.shutter": shutter,
        f"{at}.rolling_shutter_params.camera_trigger_time": trigger,
        f"{at}.rolling_shutter_params.camera_readout_done_time": done,
    }


def _box_row(key: Row, box) -> Row:
    at = "[LiDARBoxComponent]"
    return {
        **_at(key, box.frame),
        "key.laser_object_id": box.id,
        **{f"{at}.box.center.{axis}": float(value) for axis, value in zip("xyz", box.center, strict=True)},
        **{f"{at}.box.size.{axis}": float(value) for axis, value in zip("xyz", box.size, strict=True)},
        f"{at}.box.heading": box.heading,
        f"{at}.type": box.type,
    }


def _label_row(key: Row, label: LabelRecording) -> Row:
    name = "[CameraSegmentationLabelComponent].panoptic_label"
    label_columns = {f"{name}_divisor": label.divisor, name: label.content}
    return {**_at(key, label.frame), "key.camera_name": label.camera, **label_columns}


def _matrix(component: str, values: np.ndarray) -> Row:
    name = f"[{component}].range_image_return1"
    return {f"{name}.values": values.ravel().tolist(), f"{name}.shape": list(values.shape)}


def _schema(component: str, single: bool, text_keys: bool) -> pa.Schema:
    """Types as published, or those that other writers use."""
    real = pa.float32() if single else pa.float64()
    number = pa.string() if text_keys else pa.int8()
    keys = {
        "vehicle_pose": ("time",), "camera_calibration": ("camera",), "lidar_calibration": ("laser",),
        "camera_image": ("time", "camera"), "lidar": ("time", "laser"), "lidar_pose": ("time", "laser"),
        "lidar_box": ("time", "object"), "camera_segmentation": ("time", "camera"),
    }[component]  # fmt: skip
    known = {
        "time": ("key.frame_timestamp_micros", pa.string() if text_keys else pa.int64()),
        "camera": ("key.camera_name", number), "laser": ("key.laser_name", number),
        "object": ("key.laser_object_id", pa.string()),
    }  # fmt: skip
    fields = {"key.segment_context_name": pa.string(), **dict(known[key] for key in keys)}
    for name in _columns(component):
        if name.endswith((".transform", "inclination.values")):
            fields[name] = pa.list_(real, 16) if name.endswith("transform") else pa.list_(real)
        elif name.endswith((".values", ".shape")):
            fields[name] = pa.list_(pa.float32()) if name.endswith("values") else pa.list_(pa.int32(), 3)
        elif name.endswith((".width", ".height", ".type", "direction", "_divisor")):
            fields[name] = pa.int32()
        elif name.endswith((".image", "_label", "_timestamp", "_time", ".shutter")):
            fields[name] = pa.binary() if name.endswith((".image", "_label")) else pa.float64()
        else:
            fields[name] = real
    return pa.schema(list(fields.items()))


def _columns(component: str) -> list[str]:
    """The columns of a component besides its keys, by a drive with one record of each kind."""
    blank, image, label = [_Blank()], ImageRecording(0, 1, np.eye(4), 0.0, b""), LabelRecording(0, 1, b"", 1)
    sweep = RangeRecording(0, 1, np.zeros((1, 1, 4)), np.zeros((1, 1, 6)), np.zeros((1, 1, 3)))
    example = Drive("x", {0: np.eye(4)}, blank, blank, [image], [sweep], blank, [label])
    return [name for name in components(example)[component][0] if name.startswith("[")]


class _Blank:
    """A record whose values do not matter."""

    number = width = height = direction = frame = type = 0
    intrinsic, extrinsic, center, size = [0.0] * 9, np.eye(4), np.zeros(3), np.zeros(3)
    lowest = highest = heading = 0.0
    inclinations, id = None, ""


# v1: protocol buffers, https://protobuf.dev/programming-guides/encoding


def varint(value: int) -> bytes:
    value &= 2**64 - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def real(field: int, value: float) -> bytes:
    return varint(field << 3 | 1) + struct.pack("<d", value)


def block(field: int, content: bytes) -> bytes:
    return varint(field << 3 | 2) + varint(len(content)) + content


def reals(field: int, values: Iterable[float]) -> bytes:
    """Repeated doubles as proto2 writes them, each with its field."""
    return b"".join(real(field, float(value)) for value in values)


def pose(field: int, matrix: np.ndarray) -> bytes:
    return block(field, reals(1, matrix.ravel()))


def matrix_float(values: np.ndarray) -> bytes:
    """A compressed MatrixFloat: packed floats and a MatrixShape."""
    shape = b"".join(number(1, length) for length in values.shape)
    return zlib.compress(block(1, values.astype("<f4").tobytes()) + block(2, shape))


def _context(drive: Drive) -> bytes:
    content = block(1, drive.name.encode())
    for camera in drive.cameras:
        size = number(4, camera.width) + number(5, camera.height)
        extrinsic = pose(3, camera.extrinsic)
        content += block(
            2, number(1, camera.number) + reals(2, camera.intrinsic) + extrinsic + size + number(6, camera.direction)
        )
    for laser in drive.lasers:
        inclinations = b"" if laser.inclinations is None else reals(2, laser.inclinations)
        ends = real(3, laser.lowest) + real(4, laser.highest)
        content += block(3, number(1, laser.number) + inclinations + ends + pose(5, laser.extrinsic))
    return content


def _image(image: ImageRecording, labels: Iterable[LabelRecording]) -> bytes:
    shutter, trigger, done = _times(image)
    times = real(5, image.seconds) + real(6, shutter) + real(7, trigger) + real(8, done)
    own = (label for label in labels if (label.frame, label.camera) == (image.frame, image.camera))
    shown = b"".join(block(10, number(1, label.divisor) + block(2, label.content)) for label in own)
    return number(1, image.camera) + block(2, image.content) + pose(3, image.pose) + times + shown


def _laser(sweep: RangeRecording) -> bytes:
    returns = block(2, matrix_float(sweep.values))
    if sweep.poses is not None:
        returns += block(4, matrix_float(sweep.poses))
    return number(1, sweep.laser) + block(2, returns)


def _label(box) -> bytes:
    length, width, height = box.size
    sizes = real(4, width) + real(5, length) + real(6, height)
    content = reals(1, box.center[:1]) + reals(2, box.center[1:2]) + reals(3, box.center[2:]) + sizes
    return block(1, content + real(7, box.heading)) + number(3, box.type) + block(4, box.id.encode())


def frame_message(drive: Drive, time: int) -> bytes:
    """A `Frame`. Fields that no reader needs are left out, except an unknown one, which it must skip."""
    content = block(1, _context(drive)) + number(2, time) + pose(3, drive.frames[time])
    content += b"".join(block(4, _image(image, drive.labels)) for image in drive.images if image.frame == time)
    content += b"".join(block(5, _laser(sweep)) for sweep in drive.sweeps if sweep.frame == time)
    content += b"".join(block(6, _label(box)) for box in drive.boxes if box.frame == time)
    return content + block(9, number(1, 1))


def checksum(content: bytes) -> bytes:
    """TensorFlow's masked CRC-32C: rotated right by 15 bits, plus a constant."""
    crc = google_crc32c.value(content)
    rotated = (crc >> 15) | ((crc & 0x7FFF) << 17)
    return struct.pack("<I", (rotated + 0xA282EAD8) % 2**32)


def tfrecord(content: bytes) -> bytes:
    length = struct.pack("<Q", len(content))
    return length + checksum(length) + content + checksum(content)


def write_v1(root: Path, drive: Drive) -> Path:
    """Writes the segment's file, as it was published, into `root`."""
    root.mkdir(parents=True, exist_ok=True)
    records = (tfrecord(frame_message(drive, time)) for time in drive.frames)
    (root / f"segment-{drive.name}_with_camera_labels.tfrecord").write_bytes(b"".join(records))
    return root
