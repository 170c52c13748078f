"""The messages of the sensor service against an independent copy of AlpaSim's, and against their definition."""

import subprocess
import sys

import pytest
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from drivesplat.serve.messages import COMPILED, METHODS, SERVICE, wire

OWN = {own.DESCRIPTOR.full_name: own.DESCRIPTOR for own in vars(wire).values() if hasattr(own, "DESCRIPTOR")}


def nested(descriptor) -> dict:
    """A message and those within it, by full name."""
    found = {descriptor.full_name: descriptor}
    for inner in descriptor.nested_types:
        found |= nested(inner)
    return found


def described(message) -> set:
    """The fields of a message: name, number, type, whether repeated, the type's name and the oneof."""
    return {
        (field.name, field.number, field.type, field.is_repeated,
         getattr(field.message_type or field.enum_type, "full_name", None),
         getattr(field.containing_oneof, "name", None))
        for field in message.fields
    }  # fmt: skip


def all_messages(descriptors) -> dict:
    return {name: own for descriptor in descriptors for name, own in nested(descriptor).items()}


THEIRS = all_messages([*common_pb2.DESCRIPTOR.message_types_by_name.values(),
                       *sensorsim_pb2.DESCRIPTOR.message_types_by_name.values()])  # fmt: skip
ALL_OWN = all_messages(OWN.values())


def test_the_service_has_all_of_their_sensor_messages():
    of_sensors = {name for name in THEIRS if name.startswith("nre.")}
    assert of_sensors <= ALL_OWN.keys() and len(of_sensors) > 25
    assert ALL_OWN.keys() <= THEIRS.keys()


@pytest.mark.parametrize("name", sorted(ALL_OWN))
def test_every_field_is_theirs(name):
    assert described(ALL_OWN[name]) == described(THEIRS[name])


def enumerations(descriptors) -> dict:
    found = [own for descriptor in descriptors for own in descriptor.enum_types]
    return {own.full_name: {value.name: value.number for value in own.values} for own in found}


def test_every_enumeration_is_theirs():
    assert enumerations(ALL_OWN.values()) == enumerations(THEIRS[name] for name in ALL_OWN)
    for name, theirs in sensorsim_pb2.DESCRIPTOR.enum_types_by_name.items():
        own = getattr(wire, name)
        assert {member.name: member.value for member in own} == {value.name: value.number for value in theirs.values}


def test_every_rpc_is_theirs():
    theirs = sensorsim_pb2.DESCRIPTOR.services_by_name["SensorsimService"]
    assert theirs.full_name == SERVICE
    assert {name: (own.DESCRIPTOR.full_name, reply.DESCRIPTOR.full_name) for name, (own, reply) in METHODS.items()} == {
        method.name: (method.input_type.full_name, method.output_type.full_name) for method in theirs.methods
    }


def test_both_copies_live_in_one_process_and_read_each_other():
    request = wire.RGBRenderRequest(scene_id="demo", frame_end_us=2**63, camera_intrinsics={"logical_id": "front"})
    request.dynamic_objects.add(track_id="a").pose_pair.start_pose.vec.x = 1.5
    theirs = sensorsim_pb2.RGBRenderRequest.FromString(request.SerializeToString())
    assert theirs.dynamic_objects[0].pose_pair.start_pose.vec.x == 1.5 and theirs.frame_end_us == 2**63
    assert wire.RGBRenderRequest.FromString(theirs.SerializeToString()) == request
    assert type(theirs) is not type(request)


def test_the_compiled_form_is_that_of_the_definition(tmp_path):
    pytest.importorskip("grpc_tools")
    compiled = tmp_path / "again.binpb"
    command = [sys.executable, "-m", "grpc_tools.protoc", "-I", str(COMPILED.parent), "--include_imports"]
    subprocess.run([*command, f"--descriptor_set_out={compiled}", "sensorsim.proto"], check=True)
    again, known = (FileDescriptorSet.FromString(path.read_bytes()) for path in (compiled, COMPILED))
    assert again == known, "compile it: see drivesplat/serve/messages.py"
