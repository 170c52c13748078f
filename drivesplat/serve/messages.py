"""The messages of the sensor service, as classes of protobuf.

`sensorsim.binpb` is the compiled form of `sensorsim.proto`, which is loaded without the compiler:

    python -m grpc_tools.protoc -I drivesplat/serve --include_imports \
        --descriptor_set_out=drivesplat/serve/sensorsim.binpb sensorsim.proto

The classes have a descriptor pool of their own, so that a process can also load other copies of these definitions.
"""

from enum import IntEnum
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

COMPILED = Path(__file__).with_name("sensorsim.binpb")
SERVICE = "nre.grpc.protos.sensorsim.SensorsimService"
"""The full name of the service."""


def _loaded() -> tuple[Any, Any]:
    pool, files = DescriptorPool(), FileDescriptorSet.FromString(COMPILED.read_bytes())
    for file in files.file:
        pool.AddSerializedFile(file.SerializeToString())
    return pool, files


_POOL, _FILES = _loaded()
_FOUND = [_POOL.FindFileByName(file.name) for file in _FILES.file]

wire: Any = SimpleNamespace(
    **{name: GetMessageClass(own) for file in _FOUND for name, own in file.message_types_by_name.items()},
    **{
        name: IntEnum(name, {value.name: value.number for value in own.values})
        for file in _FOUND
        for name, own in file.enum_types_by_name.items()
    },
)
"""The classes of messages, and the enumerations, by their names: `wire.RGBRenderRequest(scene_id="demo")`."""

METHODS: dict[str, tuple[Any, Any]] = {
    method.name: (GetMessageClass(method.input_type), GetMessageClass(method.output_type))
    for method in _POOL.FindServiceByName(SERVICE).methods
}
"""The classes of request and reply of each rpc."""
