"""Malformed requests, clients that go away, and faults of the service itself: a status, a sentence, and it goes on."""

import subprocess
import sys
from types import SimpleNamespace

import grpc
import numpy as np
import pytest
import torch
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from helpers import REPOSITORY
from helpers.patience import wait_until
from helpers.served_drives import image_request, object_of, pinhole, served
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesplat.serve import camera_specs, requests, server
from drivesplat.serve.faults import ServiceError
from drivesplat.serve.poses import FrameTimes, ListedObjects

SCENE = "0002"
EMPTY = common_pb2.Empty()
NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module")
def stamp(street) -> int:
    return street.scene.frames[2].timestamp


@pytest.fixture(scope="module")
def sound(stamp):
    """A request that is answered."""
    pose = np.eye(4)
    return image_request(SCENE, (stamp, stamp + 20_000), (pose, pose), [object_of("a", pose, pose)])


def changed(request, path: str, value):
    """A copy of a request in which the field at a path, as in `camera_intrinsics.logical_id`, has another value; a
    callable is called with the field's message."""
    copy = type(request).FromString(request.SerializeToString())
    target, *names = copy, *path.split(".")
    for name in names[:-1]:
        target = target[int(name)] if name.isdigit() else getattr(target, name)
    if callable(value):
        value(getattr(target, names[-1]))
    else:
        setattr(target, names[-1], value)
    return copy


def refused(call, request) -> tuple[str, str]:
    """The status and the sentence of a call that is refused."""
    with pytest.raises(grpc.RpcError) as raised:
        call(request)
    code, text = raised.value.code().name, raised.value.details()
    assert text and "\n" not in text and "Traceback" not in text and len(text) < 400
    return code, text


LENS = "camera_intrinsics.opencv_pinhole_param"
MALFORMED = [
    ("scene_id", "", "NOT_FOUND", "0002"),
    ("scene_id", "clipgt-none", "NOT_FOUND", "clipgt-none"),
    ("resolution_w", 0, "INVALID_ARGUMENT", "0x48"),
    ("resolution_h", 20_000, "INVALID_ARGUMENT", "16384"),
    ("camera_intrinsics.resolution_w", 0, "INVALID_ARGUMENT", "camera_intrinsics"),
    ("camera_intrinsics.shutter_type", 0, "INVALID_ARGUMENT", "shutter_type 0"),
    ("camera_intrinsics.shutter_type", 9, "INVALID_ARGUMENT", "GLOBAL"),
    ("image_format", 0, "INVALID_ARGUMENT", "JPEG"),
    ("image_format", 5, "INVALID_ARGUMENT", "image_format 5"),
    ("image_quality", NAN, "INVALID_ARGUMENT", "image_quality"),
    ("image_quality", 101.0, "INVALID_ARGUMENT", "1 to 100"),
    ("frame_end_us", 0, "INVALID_ARGUMENT", "lasts"),
    ("frame_start_us", 0, "INVALID_ARGUMENT", "lasts"),
    ("sensor_pose.start_pose.vec.x", NAN, "INVALID_ARGUMENT", "sensor_pose: its start_pose"),
    ("sensor_pose.end_pose.vec.y", INF, "INVALID_ARGUMENT", "end_pose"),
    ("sensor_pose.end_pose.vec.y", 1e9, "INVALID_ARGUMENT", "m from the origin"),
    ("sensor_pose.start_pose", lambda pose: pose.Clear(), "INVALID_ARGUMENT", "missing"),
    ("sensor_pose.start_pose.quat", lambda quat: quat.Clear(), "INVALID_ARGUMENT", "zeros"),
    ("dynamic_objects.0.pose_pair", lambda pair: pair.Clear(), "INVALID_ARGUMENT", "dynamic object 'a'"),
    ("dynamic_objects.0.pose_pair.end_pose.quat.w", NAN, "INVALID_ARGUMENT", "dynamic object 'a'"),
    ("dynamic_objects", lambda listed: listed.add().CopyFrom(listed[0]), "INVALID_ARGUMENT", "twice"),
    (f"{LENS}.focal_length_x", 0.0, "INVALID_ARGUMENT", "focal"),
    (f"{LENS}.focal_length_x", NAN, "INVALID_ARGUMENT", "finite"),
    (f"{LENS}.focal_length_y", -40.0, "INVALID_ARGUMENT", "focal"),
    (f"{LENS}.principal_point_x", 1e6, "INVALID_ARGUMENT", "principal point"),
    (f"{LENS}.radial_coeffs", lambda own: own.extend([0.0] * 7), "INVALID_ARGUMENT", "radial_coeffs"),
    (f"{LENS}.radial_coeffs", lambda own: own.extend([NAN]), "INVALID_ARGUMENT", "finite"),
    (f"{LENS}.radial_coeffs", lambda own: own.extend([-50.0]), "INVALID_ARGUMENT", "folds"),
    (f"{LENS}.tangential_coeffs", lambda own: own.extend([0.0] * 3), "INVALID_ARGUMENT", "tangential"),
    (f"{LENS}.thin_prism_coeffs", lambda own: own.extend([0.0] * 5), "INVALID_ARGUMENT", "thin_prism"),
    ("camera_intrinsics", lambda spec: spec.ClearField("opencv_pinhole_param"), "INVALID_ARGUMENT", "no lens"),
    ("camera_intrinsics.bivariate_windshield_model_param", lambda own: own.SetInParent(), "INVALID_ARGUMENT",
     "bivariate"),
    ("camera_intrinsics.ftheta_param", lambda own: own.SetInParent(), "INVALID_ARGUMENT", "reference_poly"),
    ("camera_intrinsics.opencv_fisheye_param.max_angle", NAN, "INVALID_ARGUMENT", "max_angle"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "code", "words"), MALFORMED)
def test_a_malformed_request_is_refused_with_a_sentence(client, sound, path, value, code, words):
    found, text = refused(client.render_rgb, changed(sound, path, value))
    assert (found, words in text) == (code, True), text
    assert client.render_rgb(sound).image_bytes


def ftheta_with(**fields):
    def write(param):
        given = {"reference_poly": 2, "angle_to_pixeldist_poly": [0.0, 40.0], "principal_point_x": 32.0}
        param.CopyFrom(sensorsim_pb2.FthetaCameraParam(**{**given, **fields}))

    return write


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"angle_to_pixeldist_poly": []}, "constant"),
        ({"angle_to_pixeldist_poly": [1.0, 40.0]}, "constant"),
        ({"angle_to_pixeldist_poly": [0.0, -40.0]}, "positive"),
        ({"angle_to_pixeldist_poly": [0.0, NAN]}, "positive"),
        ({"angle_to_pixeldist_poly": [0.0, *[1.0] * 17]}, "16 powers"),
        ({"reference_poly": 1}, "pixeldist_to_angle_poly"),
        ({"max_angle": -1.0}, "max_angle"),
        ({"linear_cde": sensorsim_pb2.LinearCde()}, "linear_cde"),
        ({"linear_cde": sensorsim_pb2.LinearCde(linear_c=1.0, linear_d=2.0, linear_e=2.0)}, "mirrors"),
        ({"linear_cde": sensorsim_pb2.LinearCde(linear_c=1.0, linear_d=INF)}, "linear_cde"),
    ],
)
def test_a_malformed_ftheta_lens_is_refused_with_a_sentence(client, sound, fields, words):
    found, text = refused(client.render_rgb, changed(sound, "camera_intrinsics.ftheta_param", ftheta_with(**fields)))
    assert (found, words in text) == ("INVALID_ARGUMENT", True), text


@pytest.mark.parametrize("offset", [-1_000_001, 4_600_000])
def test_a_time_outside_of_the_recording_is_out_of_range(client, sound, stamp, offset):
    moved = changed(changed(sound, "frame_start_us", stamp + offset), "frame_end_us", stamp + offset)
    code, text = refused(client.render_rgb, moved)
    assert code == "OUT_OF_RANGE" and str(stamp + offset) in text and "recorded from" in text


def test_masks_and_cameras_that_are_not_there_are_not_found(client, sound):
    masked = changed(sound, "insert_ego_mask", True)
    sentence = "scene 0002 has no ego mask of camera 'CAM_FRONT'; it has: none"
    assert refused(client.render_rgb, masked) == ("NOT_FOUND", sentence)
    masked = changed(changed(masked, "scene_id", "0001/street"), "ego_mask_id.camera_logical_id", "CAM_BACK")
    code, text = refused(client.render_rgb, masked)
    assert code == "NOT_FOUND" and "CAM_BACK" in text and "CAM_FRONT" in text
    for call, request in (
        (client.get_available_cameras, sensorsim_pb2.AvailableCamerasRequest(scene_id="x")),
        (client.get_available_trajectories, sensorsim_pb2.AvailableTrajectoriesRequest(scene_id="x")),
    ):
        assert refused(call, request)[0] == "NOT_FOUND"


def test_what_is_too_large_is_resource_exhausted(client, sound, monkeypatch):
    monkeypatch.setattr(camera_specs, "MAX_PIXELS", 1000)
    code, text = refused(client.render_rgb, sound)
    assert code == "RESOURCE_EXHAUSTED" and "64x48" in text
    monkeypatch.setattr(camera_specs, "MAX_PIXELS", 10**6)
    monkeypatch.setattr(requests, "MAX_REQUEST_PIXELS", 2 * 64 * 48)
    batch = sensorsim_pb2.BatchRGBRenderRequest()
    for _ in range(3):
        batch.items.add(request=sound)
    assert refused(client.batch_render_rgb, batch)[0] == "RESOURCE_EXHAUSTED"
    monkeypatch.setattr(server, "MAX_MESSAGE_BYTES", 50)
    code, text = refused(client.render_rgb, sound)
    assert code == "RESOURCE_EXHAUSTED" and "may have 50" in text


FLOATS = st.floats(width=32)
POSES = st.builds(
    lambda numbers: common_pb2.Pose(
        vec=common_pb2.Vec3(x=numbers[0], y=numbers[1], z=numbers[2]),
        quat=common_pb2.Quat(w=numbers[3], x=numbers[4], y=numbers[5], z=numbers[6]),
    ),
    st.lists(FLOATS, min_size=7, max_size=7),
)
PAIRS = st.builds(lambda start, end: sensorsim_pb2.PosePair(start_pose=start, end_pose=end), POSES, POSES)
DOUBLES = st.one_of(st.floats(), st.sampled_from([0.0, 24.0, 40.0]))
LISTS = st.lists(st.floats(), max_size=8)
PINHOLES = st.builds(
    lambda numbers, k, p: sensorsim_pb2.OpenCVPinholeCameraParam(
        focal_length_x=numbers[0], focal_length_y=numbers[1], principal_point_x=numbers[2],
        principal_point_y=numbers[3], radial_coeffs=k, tangential_coeffs=p,
    ),
    st.lists(DOUBLES, min_size=4, max_size=4), LISTS, LISTS,
)  # fmt: skip
FTHETAS = st.builds(
    lambda kind, numbers, poly, cde: sensorsim_pb2.FthetaCameraParam(
        reference_poly=kind, pixeldist_to_angle_poly=poly, angle_to_pixeldist_poly=poly, principal_point_x=numbers[0],
        principal_point_y=numbers[1], max_angle=numbers[2],
        linear_cde=sensorsim_pb2.LinearCde(linear_c=cde[0], linear_d=cde[1], linear_e=cde[2]),
    ),
    st.integers(0, 2), st.lists(DOUBLES, min_size=3, max_size=3), LISTS, st.lists(DOUBLES, min_size=3, max_size=3),
)  # fmt: skip


@settings(max_examples=100)
@given(data=st.data())
def test_any_request_gets_an_image_or_a_sentence(client, sound, data):
    """Of every field, hypothesis chooses whether and how it differs from that of a sound request."""
    request = type(sound).FromString(sound.SerializeToString())
    for name, values in {
        "scene_id": st.text(max_size=8), "resolution_w": st.integers(0, 96), "resolution_h": st.integers(0, 96),
        "frame_start_us": st.integers(0, 2**64 - 1), "frame_end_us": st.integers(0, 2**64 - 1),
        "image_format": st.integers(0, 9), "image_quality": FLOATS, "insert_ego_mask": st.booleans(),
    }.items():  # fmt: skip
        if data.draw(st.integers(0, 5)) == 0:
            setattr(request, name, data.draw(values))
    if data.draw(st.integers(0, 3)) == 0:
        request.sensor_pose.CopyFrom(data.draw(PAIRS))
    if data.draw(st.integers(0, 3)) == 0:
        request.dynamic_objects.add(track_id=data.draw(st.text(max_size=3)), pose_pair=data.draw(PAIRS))
    lens = data.draw(st.integers(0, 4))
    if lens == 0:
        request.camera_intrinsics.opencv_pinhole_param.CopyFrom(data.draw(PINHOLES))
    elif lens == 1:
        request.camera_intrinsics.ftheta_param.CopyFrom(data.draw(FTHETAS))
    request.camera_intrinsics.shutter_type = data.draw(st.integers(0, 6))
    try:
        assert client.render_rgb(request).image_bytes
    except grpc.RpcError as error:
        assert error.code().name in {"INVALID_ARGUMENT", "NOT_FOUND", "OUT_OF_RANGE", "RESOURCE_EXHAUSTED"}, error
        assert error.details() and "\n" not in error.details()


@pytest.mark.parametrize("name", ["render_rgb", "batch_render_rgb", "render_lidar", "get_version"])
def test_bytes_that_are_no_message_are_an_invalid_argument(client, name):
    code, text = refused(lambda request: client.raw(name, request), b"\xff\xff\xff not a message")
    assert code == "INVALID_ARGUMENT" and "the request is no" in text


def test_a_fault_of_the_service_is_an_internal_error_and_is_logged(results, sound, monkeypatch, caplog):
    with served(results / "0002") as (running, client):
        with monkeypatch.context() as broken:
            broken.setattr(running.service._drives, "get", lambda name: 1 / 0)
            code, text = refused(client.render_rgb, sound)
            assert code == "INTERNAL" and "ZeroDivisionError" in text and "division" not in text
            assert any(record.exc_info for record in caplog.records)
            broken.setattr(running.service._drives, "get", lambda name: _out_of_memory())
            assert refused(client.render_rgb, sound)[0] == "RESOURCE_EXHAUSTED"
        assert client.render_rgb(sound).image_bytes


def _out_of_memory():
    raise torch.cuda.OutOfMemoryError("CUDA out of memory")


KILLED = """
import sys
import grpc
channel = grpc.insecure_channel(sys.argv[1])
channel.unary_unary("/nre.grpc.protos.sensorsim.SensorsimService/render_rgb")(bytes.fromhex(sys.argv[2]))
"""


def test_a_client_that_is_killed_in_mid_request_leaves_a_service_that_goes_on(results, sound, monkeypatch):
    with served(results / "0002") as (running, client):
        expected, render_rgb = client.render_rgb(sound).image_bytes, running.service.render_rgb
        figures, waiting = running.service.figures.registry, []
        calls = {"rpc": "render_rgb", "code": "CANCELLED"}

        def noted(message, active):
            waiting.append(active)
            return render_rgb(message, active)

        with monkeypatch.context() as changed, running.service._lock:  # the request waits for the device
            changed.setattr(running.service, "render_rgb", noted)
            command = [sys.executable, "-c", KILLED, running.address, sound.SerializeToString().hex()]
            other = subprocess.Popen(command, cwd=REPOSITORY)
            wait_until(lambda: waiting and figures.get_sample_value("drivesplat_waiting_requests") == 1.0)
            assert waiting[0]()
            other.kill()
            other.wait()
            wait_until(lambda: not waiting[0]())  # the server learns of it by the closed connection
        wait_until(lambda: figures.get_sample_value("drivesplat_rpc_seconds_count", calls) == 1.0)
        assert figures.get_sample_value("drivesplat_waiting_requests") == 0.0
        assert client.render_rgb(sound).image_bytes == expected


def test_shutters_are_named_where_one_is_unknown(client, sound):
    _, text = refused(client.render_rgb, changed(sound, "camera_intrinsics", lambda own: own.CopyFrom(pinhole(0))))
    assert "ROLLING_TOP_TO_BOTTOM" in text


def test_a_track_that_a_long_list_has_twice_is_found_in_few_comparisons():
    compared = []

    class Name(str):
        def __eq__(self, other):
            compared.append(other)
            return str.__eq__(self, other)

        __hash__ = str.__hash__

    messages = [SimpleNamespace(track_id=Name(f"t{min(i, 998)}")) for i in range(1000)]
    with pytest.raises(ServiceError, match="'t998' twice"):
        ListedObjects.of(messages, FrameTimes(0, 0, False))
    assert len(compared) < 10 * len(messages)
