"""Segments of v1: a TFRecord file with one `Frame` message for each frame. Messages are built at run time from their
published field numbers.

The numbers are those of src/waymo_open_dataset/dataset.proto and label.proto in the repository
github.com/waymo-research/waymo-open-dataset (proto2); fields that are not read are left out, and the parser skips them.
Two types differ here without a difference in the file: enumerations are numbers, and texts and packed floats are bytes
(of little-endian float32), since numpy reads these a hundred times faster than a list.
"""

import struct
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from drivesplat.errors import DatasetError
from drivesplat.readers.record_names import shown
from drivesplat.readers.waymo.layout import SegmentFiles
from drivesplat.readers.waymo.names import FRAMES, TOP
from drivesplat.readers.waymo.segment import (
    MAX_CELLS,
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

TRUNCATED, ALTERED = "is truncated; download the file again", "differs; download the file again"
_HEADER, _FOOTER = struct.Struct("<QI"), struct.Struct("<I")
_PACKAGE = "waymo.open_dataset"
_FIELDS = {
    "MatrixShape": {"dims": (1, "repeated int32")},
    "MatrixFloat": {"data": (1, "bytes"), "shape": (2, "MatrixShape")},
    "Transform": {"transform": (1, "repeated double")},
    "CameraCalibration": {
        "name": (1, "int32"),
        "intrinsic": (2, "repeated double"),
        "extrinsic": (3, "Transform"),
        "width": (4, "int32"),
        "height": (5, "int32"),
        "rolling_shutter_direction": (6, "int32"),
    },
    "LaserCalibration": {
        "name": (1, "int32"),
        "beam_inclinations": (2, "repeated double"),
        "beam_inclination_min": (3, "double"),
        "beam_inclination_max": (4, "double"),
        "extrinsic": (5, "Transform"),
    },
    "Context": {
        "name": (1, "bytes"),
        "camera_calibrations": (2, "repeated CameraCalibration"),
        "laser_calibrations": (3, "repeated LaserCalibration"),
    },
    "RangeImage": {"range_image_compressed": (2, "bytes"), "range_image_pose_compressed": (4, "bytes")},
    "Laser": {"name": (1, "int32"), "ri_return1": (2, "RangeImage")},
    "CameraSegmentationLabel": {"panoptic_label_divisor": (1, "int32"), "panoptic_label": (2, "bytes")},
    "CameraImage": {
        "name": (1, "int32"),
        "image": (2, "bytes"),
        "pose": (3, "Transform"),
        "pose_timestamp": (5, "double"),
        "shutter": (6, "double"),
        "camera_trigger_time": (7, "double"),
        "camera_readout_done_time": (8, "double"),
        "camera_segmentation_label": (10, "CameraSegmentationLabel"),
    },
    "Box": {
        "center_x": (1, "double"),
        "center_y": (2, "double"),
        "center_z": (3, "double"),
        "width": (4, "double"),
        "length": (5, "double"),
        "height": (6, "double"),
        "heading": (7, "double"),
    },
    "Label": {"box": (1, "Box"), "type": (3, "int32"), "id": (4, "bytes")},
    "Frame": {
        "context": (1, "Context"),
        "timestamp_micros": (2, "int64"),
        "pose": (3, "Transform"),
        "images": (4, "repeated CameraImage"),
        "lasers": (5, "repeated Laser"),
        "laser_labels": (6, "repeated Label"),
    },
}
_TYPES = {
    "bytes": descriptor_pb2.FieldDescriptorProto.TYPE_BYTES,
    "double": descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE,
    "int32": descriptor_pb2.FieldDescriptorProto.TYPE_INT32,
    "int64": descriptor_pb2.FieldDescriptorProto.TYPE_INT64,
}


def read_segment(files: SegmentFiles) -> Segment:
    """The segment of a file, read one frame at a time."""
    segment = Segment(files.name, files.version)
    for frame in _frames(files):
        time = frame.timestamp_micros
        if time in segment.frames:
            raise DatasetError(f"{frame_name(time)}: {files.files[FRAMES]} has it twice")
        segment.frames[time] = list(frame.pose.transform)
        if len(segment.frames) == 1:
            _add_calibrations(segment, frame.context)
        for image in frame.images:
            record = ImageRecord(
                time, image.name, list(image.pose.transform), image.pose_timestamp, image.shutter,
                image.camera_trigger_time, image.camera_readout_done_time,
            )  # fmt: skip
            segment.images.append(record)
        for label in frame.laser_labels:
            box, id_ = label.box, label.id.decode(errors="replace")
            center, size = [box.center_x, box.center_y, box.center_z], [box.length, box.width, box.height]
            segment.boxes.append(BoxRecord(time, id_, label.type, center, size, box.heading))
        for laser in frame.lasers:
            if laser.ri_return1.range_image_compressed:
                segment.sweeps.append((time, laser.name))
                if laser.name not in segment.shapes:
                    segment.shapes[laser.name] = _returns(laser, time).shape[:2]
    return segment


def read_recordings(files: SegmentFiles, wanted: ChosenRecordings) -> Iterator[ImageFile | PanopticLabel | RangeImage]:
    """The wanted images, with their labels, and range images, one at a time."""
    calibrated = Segment(files.name, files.version)
    for frame in _frames(files):
        time = frame.timestamp_micros
        if not calibrated.lasers:
            _add_calibrations(calibrated, frame.context)
        for image in frame.images:
            if (time, image.name) in wanted.images:
                yield ImageFile(time, image.name, image.image)
                label = image.camera_segmentation_label
                if label.panoptic_label:
                    yield PanopticLabel(time, image.name, label.panoptic_label, label.panoptic_label_divisor)
        for laser in frame.lasers:
            if (time, laser.name) in wanted.sweeps:
                values, poses = _returns(laser, time), None
                if laser.name == TOP:
                    poses = _matrix(laser.ri_return1.range_image_pose_compressed, 6, sweep_name(TOP, time))
                yield RangeImage(time, calibrated.laser(laser.name), list(frame.pose.transform), values, poses)


def _frames(files: SegmentFiles) -> Iterator[Any]:
    """The frames of a segment's file, in its order."""
    path, frame_of = files.files[FRAMES], message("Frame")
    number = -1
    for number, record in enumerate(tfrecords(path)):
        try:
            frame = frame_of.FromString(record)
        except DecodeError as error:
            raise DatasetError(
                f"record {number} of {path} is no Frame message ({error}): the file holds no frames, but records of "
                "another kind; docs/waymo.md says what to download"
            ) from error
        name = frame.context.name.decode(errors="replace")
        if name != files.name and not (frame.HasField("timestamp_micros") and frame.HasField("pose")):
            raise DatasetError(
                f"{path} holds no frames: record {number} is of another kind, such as those of Waymo's motion dataset; "
                "docs/waymo.md says what to download"
            )
        if name != files.name:
            raise DatasetError(
                f"record {number} of {path} is a frame of segment {shown(name)}, and the file is called {files.name}; "
                "name it after its segment, as it was published"
            )
        yield frame
    if number < 0:
        raise DatasetError(f"{path} is empty; download it again")


def _add_calibrations(segment: Segment, context: Any) -> None:
    for camera in context.camera_calibrations:
        segment.cameras[camera.name] = CameraRecord(
            camera.name, list(camera.intrinsic), list(camera.extrinsic.transform), camera.width, camera.height,
            camera.rolling_shutter_direction,
        )  # fmt: skip
    for laser in context.laser_calibrations:
        segment.lasers[laser.name] = LaserRecord(
            laser.name, list(laser.beam_inclinations), laser.beam_inclination_min, laser.beam_inclination_max,
            list(laser.extrinsic.transform),
        )  # fmt: skip


def _returns(laser: Any, time: int) -> np.ndarray:
    return _matrix(laser.ri_return1.range_image_compressed, 4, sweep_name(laser.name, time))


def _matrix(compressed: bytes, channels: int, record: str) -> np.ndarray:
    """A zlib-compressed MatrixFloat (rows, columns, channels)."""
    limit = 4 * MAX_CELLS * channels
    try:
        unpacked = zlib.decompressobj().decompress(compressed, limit)
        matrix = message("MatrixFloat").FromString(unpacked)
    except (zlib.error, DecodeError) as error:
        raise DatasetError(f"{record}: its range image is damaged ({error})") from error
    data = matrix.data[: len(matrix.data) // 4 * 4]
    return cells(np.frombuffer(data, dtype="<f4"), matrix.shape.dims, channels, record)


def tfrecords(path: Path) -> Iterator[bytes]:
    """The records of a TFRecord file, one at a time: uint64 length, its masked CRC-32C, data, their masked CRC-32C, all
    little-endian. tensorflow/core/lib/io/record_writer.h documents the format, crc32c.h the mask.

    Raises DatasetError naming the record where the file is truncated or a checksum differs.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        number = 0
        while file.tell() < size:
            record = f"record {number} of {path}"
            header = file.read(_HEADER.size)
            if len(header) < _HEADER.size:
                raise DatasetError(f"{record} {TRUNCATED}")
            length, checksum = _HEADER.unpack(header)
            if masked_crc(header[:8]) != checksum:
                raise DatasetError(f"{record}: the checksum (CRC-32C) of its length {ALTERED}")
            if length > size - file.tell() - _FOOTER.size:
                raise DatasetError(f"{record} {TRUNCATED}")
            data, footer = file.read(length), file.read(_FOOTER.size)
            if len(data) < length or len(footer) < _FOOTER.size:
                raise DatasetError(f"{record} {TRUNCATED}")
            if masked_crc(data) != _FOOTER.unpack(footer)[0]:
                raise DatasetError(f"{record}: the checksum (CRC-32C) of its data {ALTERED}")
            yield data
            number += 1


def masked_crc(data: bytes) -> int:
    """The masked CRC-32C of a record's part."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


@cache
def message(name: str) -> type[Any]:
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"{_PACKAGE}.{name}"))


@cache
def _pool() -> Any:
    file = descriptor_pb2.FileDescriptorProto(name="waymo.proto", package=_PACKAGE, syntax="proto2")
    for name, fields in _FIELDS.items():
        record = file.message_type.add(name=name)
        for field, (number, kind) in fields.items():
            *repeated, kind = kind.split()
            added = record.field.add(name=field, number=number)
            added.label = added.LABEL_REPEATED if repeated else added.LABEL_OPTIONAL
            if kind in _TYPES:
                added.type = _TYPES[kind]
            else:
                added.type, added.type_name = added.TYPE_MESSAGE, f".{_PACKAGE}.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return pool
