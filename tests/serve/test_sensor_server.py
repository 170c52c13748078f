"""The server: its address, encryption, health, figures, its end, several clients, and a policy that drives by it."""

import re
import signal
import socket
import subprocess
import sys
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import grpc
import numpy as np
import pytest
from carla_driver_interface._proto import common_pb2, egodriver_pb2, sensorsim_pb2
from carla_driver_interface.driver import BaseDriver
from carla_driver_interface.geometry import Pose, Trajectory, waypoints_to_proto
from carla_driver_interface.inprocess import in_process_channel
from carla_driver_interface.policies.route_follower import RouteFollowerPolicy
from carla_driver_interface.protocol import EgodriverServiceStub
from grpc_health.v1 import health_pb2, health_pb2_grpc
from helpers import REPOSITORY
from helpers.patience import PATIENCE_S, wait_until
from helpers.served_drives import CAMERA, SERVICE, SensorClient, decoded, image_request, message_of, pose_of, served

import drivesplat
from drivesplat.cli.__main__ import main
from drivesplat.errors import RequestError
from drivesplat.settings.simulate import VehicleSettings
from drivesplat.simulate.vehicle import RecordedGround, advanced, control_towards, state_of

EMPTY = common_pb2.Empty()


@pytest.fixture(scope="module")
def stamp(street) -> int:
    return street.scene.frames[2].timestamp


@pytest.fixture(scope="module")
def sound(stamp, street):
    pose = street.camera_to_world(CAMERA, street.scene.seconds(stamp))
    return image_request("0002", (stamp, stamp), (pose, pose))


def test_two_clients_at_once_get_equal_bytes(results, sound, stamp):
    """Requests for other scenes and other cameras interleave with theirs."""
    other = image_request("0001/street", (stamp, stamp), (np.eye(4), np.eye(4)), image_format=sensorsim_pb2.JPEG)
    with served(results, max_loaded=1) as (running, client), ThreadPoolExecutor(6) as threads:
        expected = [client.render_rgb(request).image_bytes for request in (sound, other)]
        clients = [SensorClient(running.address) for _ in range(2)]
        calls = [(clients[i % 2], (i // 2) % 2) for i in range(8)]
        found = [*threads.map(lambda call: call[0].render_rgb([sound, other][call[1]]).image_bytes, calls)]
        assert found == [expected[which] for _, which in calls]
        for own in clients:
            own.channel.close()


def test_health_and_figures(results, sound):
    with served(results / "0002", metrics_port=0) as (running, client):
        health = health_pb2_grpc.HealthStub(client.channel)
        for service in ("", SERVICE.full_name):
            status = health.Check(health_pb2.HealthCheckRequest(service=service)).status
            assert status == health_pb2.HealthCheckResponse.SERVING
        size = len(client.render_rgb(sound).image_bytes)
        with pytest.raises(grpc.RpcError):
            client.render_rgb(sensorsim_pb2.RGBRenderRequest())
        assert running.metrics_address.startswith("http://127.0.0.1:")
        wait_until(lambda: 'code="NOT_FOUND"' in _page(running))
        page = _page(running)
        assert 'drivesplat_rpc_seconds_count{code="OK",rpc="render_rgb"} 1.0' in page
        assert f'drivesplat_encoded_bytes_total{{format="PNG"}} {float(size)}' in page
        assert "drivesplat_waiting_requests 0.0" in page and "drivesplat_loaded_scenes 1.0" in page
        assert float(re.search(r"^drivesplat_model_seconds_total (\S+)", page, re.MULTILINE)[1]) > 0.0


def test_health_version_and_figures_answer_while_calls_wait_and_further_ones_are_refused(results, sound):
    with served(results / "0002", max_calls=3, metrics_port=0) as (running, client), ExitStack() as others:
        expected = client.render_rgb(sound).image_bytes
        with running.service._lock:  # the device is in use
            waiting = [client.render_rgb.future(sound) for _ in range(3)]
            wait_until(lambda: "drivesplat_waiting_requests 3.0" in _page(running))
            for call, request in (
                (client.render_rgb, sound), (client.batch_render_rgb, sensorsim_pb2.BatchRGBRenderRequest()),
                (client.get_available_cameras, sensorsim_pb2.AvailableCamerasRequest(scene_id="0002")),
            ):  # fmt: skip
                with pytest.raises(grpc.RpcError, match=r"3 calls are in progress.*--max-calls") as raised:
                    call(request, timeout=PATIENCE_S)
                assert raised.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
            clients = [SensorClient(running.address) for _ in range(4)]
            for own in clients:
                others.callback(own.channel.close)
            refused = [own.render_rgb.future(sound) for own in clients for _ in range(10)]
            health = health_pb2_grpc.HealthStub(client.channel)
            check = health.Check(health_pb2.HealthCheckRequest(), timeout=PATIENCE_S)
            assert check.status == health_pb2.HealthCheckResponse.SERVING
            assert client.get_version(EMPTY, timeout=PATIENCE_S).version_id
            assert [*client.get_available_scenes(EMPTY, timeout=PATIENCE_S).scene_ids] == ["0002"]
            assert len(client.get_loaded_scenes(EMPTY, timeout=PATIENCE_S).scenes) == 1
            assert not client.get_available_ego_masks(EMPTY, timeout=PATIENCE_S).ego_mask_metadata
            for call in refused:
                assert call.exception(PATIENCE_S).code() == grpc.StatusCode.RESOURCE_EXHAUSTED
            assert not any(call.done() for call in waiting)
        assert [call.result(PATIENCE_S).image_bytes for call in waiting] == 3 * [expected]
        assert client.render_rgb(sound).image_bytes == expected, "places are free again"


def _page(running) -> str:
    with urllib.request.urlopen(running.metrics_address) as answer:
        return answer.read().decode()


def test_connections_can_be_encrypted(results, tmp_path):
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", certificate]
    try:
        subprocess.run([*command, "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"],
                       check=True, capture_output=True)  # fmt: skip
    except FileNotFoundError:
        pytest.skip("openssl is missing")
    with served(results / "0002", tls=(certificate, key)) as (running, plain):
        with pytest.raises(grpc.RpcError):
            plain.get_version(EMPTY)
        encrypted = SensorClient(running.address, certificate.read_bytes())
        assert encrypted.get_version(EMPTY).version_id
        encrypted.channel.close()


def test_what_cannot_be_served_is_one_sentence(results, tmp_path, monkeypatch):
    one = results / "0002"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        for options, words in (
            ({"address": address}, address), ({"address": "nowhere"}, "--address"),
            ({"address": "h:99999"}, "--address"),
            ({"address": "host.invalid:1"}, r"host\.invalid"), ({"address": "a..b:1"}, r"a\.\.b"),
            ({"max_loaded": 0}, "--max-loaded"), ({"max_calls": 0}, "--max-calls"),
            ({"metrics_port": taken.getsockname()[1]}, "--metrics-port"),
            ({"tls": (tmp_path / "none.pem", tmp_path / "none.pem")}, r"none\.pem"),
            ({"tls": (Path(__file__), Path(__file__))}, "a certificate and its key"),
        ):  # fmt: skip
            with pytest.raises(RequestError, match=words) as raised:
                drivesplat.SensorServer([one], **{"address": "127.0.0.1:0", "device": "cpu", **options})
            assert "\n" not in str(raised.value)
    monkeypatch.setitem(sys.modules, "grpc", None)
    with pytest.raises(RequestError, match=r"pip install 'drivesplat\[serve\]'"):
        drivesplat.SensorServer([one], "127.0.0.1:0", device="cpu")


def test_a_server_that_cannot_start_leaves_its_addresses_free(results):
    ports, one = [], results / "0002"
    with socket.socket() as first, socket.socket() as second, socket.socket() as taken:
        for own in (first, second, taken):
            own.bind(("127.0.0.1", 0))
            ports.append(own.getsockname()[1])
        taken.listen()
        first.close()
        second.close()
        address = f"127.0.0.1:{ports[0]}"
        with pytest.raises(RequestError, match="--metrics-port"):
            drivesplat.SensorServer([one], address, device="cpu", metrics_port=ports[2])
        with pytest.raises(RequestError, match="certificate"):
            no_key = Path(__file__), Path(__file__)
            drivesplat.SensorServer([one], address, device="cpu", metrics_port=ports[1], tls=no_key)
        server = drivesplat.SensorServer([one], address, device="cpu", metrics_port=ports[1])
        assert server.address == address and server.metrics_address == f"http://127.0.0.1:{ports[1]}/metrics"
        server.close(None)


def test_the_command_refuses_half_of_an_encryption(results, capsys):
    assert main(["serve", str(results), "--tls-cert", "cert.pem"]) == 1
    assert "--tls-key" in capsys.readouterr().err


def test_a_signal_ends_the_command_when_calls_have_been_answered(results, sound):
    command = [sys.executable, "-m", "drivesplat.cli", "serve", str(results / "0002"), "--address", "127.0.0.1:0"]
    process = subprocess.Popen([*command, "--device", "cpu"], stdout=subprocess.PIPE, text=True, cwd=REPOSITORY)
    try:
        said = [process.stdout.readline() for _ in range(2)]
        assert "slow" in said[0]
        address = re.search(r"serve: (\S+) serves 0002;", said[1])[1]
        client = SensorClient(address)
        pending = client.render_rgb.future(sound)  # loads the scene, compiles kernels
        health = health_pb2_grpc.HealthStub(client.channel)
        wait_until(lambda: health.Check(health_pb2.HealthCheckRequest()).status)
        wait_until(lambda: client.get_available_scenes(EMPTY).scene_ids)
        process.send_signal(signal.SIGTERM)
        assert "ending" in process.stdout.readline()
        assert decoded(pending.result(PATIENCE_S).image_bytes).shape == (48, 64, 3)
        assert process.wait(PATIENCE_S) == 0
        client.channel.close()
    finally:
        process.kill()
        process.communicate()


# ---- a policy


class Watching(RouteFollowerPolicy):
    """The reference policy, which keeps what its camera showed."""

    def __init__(self):
        super().__init__(cruise_speed_mps=5.0)
        self.seen: list[np.ndarray] = []

    def on_frame(self, session, frame) -> None:
        self.seen.append(frame.as_array())


def test_a_policy_drives_by_the_images_of_the_service(results, street):
    """AlpaSim's order of calls: cameras, then in each step images, motion and route to the policy, whose plan a
    kinematic bicycle follows."""
    step_s, limits, policy = 0.1, VehicleSettings(), Watching()
    assert isinstance(policy, BaseDriver)
    driver = EgodriverServiceStub(in_process_channel(policy, "alpasim"))
    with served(results / "0001/street", unlisted="recorded") as (_, client):
        (scene_id,) = client.get_available_scenes(EMPTY).scene_ids
        (camera,) = client.get_available_cameras(
            sensorsim_pb2.AvailableCamerasRequest(scene_id=scene_id)
        ).available_cameras  # fmt: skip
        request = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id=scene_id)
        recorded = client.get_available_trajectories(request).available_trajectories[0].trajectory.poses
        path, start_us = np.stack([pose_of(own.pose) for own in recorded]), recorded[0].timestamp_us
        ground, ego = RecordedGround(path), state_of(path[0], 4.0, 0.0, limits.wheelbase)
        begin = egodriver_pb2.DriveSessionRequest(session_uuid="a", random_seed=0)
        begin.rollout_spec.vehicle.available_cameras.append(camera)
        driver.start_session(begin)
        for step in range(15):
            now_us, rig = start_us + step * 100_000, ground.ego_to_world(ego)
            pose = rig @ pose_of(camera.rig_to_camera)
            shown = image_request(scene_id, (now_us, now_us), (pose, pose), spec=camera.intrinsics)
            image = egodriver_pb2.RolloutCameraImage(session_uuid="a")
            image.camera_image.logical_id = camera.logical_id
            image.camera_image.frame_start_us = image.camera_image.frame_end_us = now_us
            image.camera_image.image_bytes = client.render_rgb(shown).image_bytes
            driver.submit_image_observation(image)
            motion = egodriver_pb2.RolloutEgoTrajectory(session_uuid="a")
            motion.trajectory.poses.add(pose=message_of(rig), timestamp_us=now_us)
            motion.dynamic_states.add().linear_velocity.x = ego.speed
            driver.submit_egomotion_observation(motion)
            ahead = Pose.from_proto(message_of(rig)).inverse().transform_points(path[:, :3, 3])
            ahead = np.vstack([np.zeros(3), ahead[ahead[:, 0] > 0.0]])
            route = egodriver_pb2.Route(timestamp_us=now_us, waypoints=waypoints_to_proto(ahead))
            driver.submit_route(egodriver_pb2.RouteRequest(session_uuid="a", route=route))
            times = {"time_now_us": now_us, "time_query_us": now_us + 100_000}
            plan = Trajectory.from_proto(driver.drive(egodriver_pb2.DriveRequest(session_uuid="a", **times)).trajectory)
            wanted = [plan.interpolate(now_us + 100_000 * (i + 1)) for i in range(10)]
            local = [Pose.from_proto(message_of(rig)).inverse() @ own for own in wanted]
            poses = np.array([[*own.position[:2], own.yaw] for own in local])
            ego = advanced(ego, *control_towards(ego, poses, step_s, limits), step_s, limits)
        driver.close_session(egodriver_pb2.DriveSessionCloseRequest(session_uuid="a"))
    driven = ground.ego_to_world(ego)[:3, 3]
    assert np.linalg.norm(path[:, :3, 3] - driven, axis=1).min() < 1.0 and driven[0] > 4.0
    assert len(policy.seen) == 15 and all(image.std() > 5.0 for image in policy.seen)
    assert any(np.abs(a.astype(int) - b).max() > 20 for a, b in zip(policy.seen, policy.seen[1:], strict=False))


def test_the_example_of_the_guide_drives(results, capsys):
    page = (REPOSITORY / "docs/simulators.md").read_text(encoding="utf-8")
    (code,) = (block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "RouteFollowerPolicy" in block)
    with served(results / "0002", unlisted="recorded") as (running, _):
        exec(code.replace("127.0.0.1:50051", running.address), {})
    offset = re.search(r"driven to .*, (\S+) m from the path", capsys.readouterr().out)[1]
    assert float(offset) < 1.5


def test_a_service_may_be_started_by_a_relative_path(results, monkeypatch):
    monkeypatch.chdir(results / "0002/street")
    with served(Path()) as (running, _):
        assert running.scenes == ["0002"]
