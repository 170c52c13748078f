"""The messages of v1, built at run time from their published field numbers.

The numbers are those of src/waymo_open_dataset/dataset.proto and label.proto in the repository
github.com/waymo-research/waymo-open-dataset (proto2); fields that are not read are left out, and the parser skips them.
Two types differ here without a difference in the file: enumerations are numbers, and texts and packed floats are bytes
(of little-endian float32), since numpy reads these a hundred times faster than a list.
"""

from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

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


@cache
def message(name: str) -> type[Any]:
    """The class of a message."""
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
