"""Scans of the sensor service."""

import grpc
import numpy as np
import pytest
from carla_driver_interface._proto import sensorsim_pb2
from helpers.scanned_street import WALL_AT
from helpers.served_drives import motion_of, pair_of, pose_of

import drivesplat
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.serve.lidar_patterns import at128, pandar128

SCENE, SECONDS, LENGTH_US = "0001/street_lidar", 1.0, 100_000
LIDAR = "LIDAR_TOP"


@pytest.fixture(scope="module")
def drive(results):
    return drivesplat.open(results / SCENE, device="cpu")


@pytest.fixture(scope="module")
def start_us(drive) -> int:
    return min(frame.timestamp for frame in drive.scene.frames) + round(1e6 * SECONDS) - LENGTH_US // 2


def scan_request(start_us: int, pair, scene_id: str = SCENE, **fields):
    return sensorsim_pb2.LidarRenderRequest(
        scene_id=scene_id, frame_start_us=start_us, frame_end_us=start_us + LENGTH_US, sensor_pose=pair, **fields
    )


@pytest.fixture(scope="module")
def pair(drive):
    """A LiDAR that drives ahead with 4 m/s, and turns."""
    ends = []
    for side in (-1, 1):
        turn = np.array([[np.cos(0.02 * side), -np.sin(0.02 * side), 0], [np.sin(0.02 * side), np.cos(0.02 * side), 0],
                         [0, 0, 1]])  # fmt: skip
        ends.append(rigid(turn, np.array([4.0 * SECONDS + side * 0.2, 0.0, 1.8])))
    return pair_of(*ends)


def points_of(reply) -> np.ndarray:
    points = np.array(reply.point_xyzs, dtype=np.float32).reshape(-1, 3)
    assert reply.num_points == len(points) > 0
    np.testing.assert_array_equal(np.frombuffer(reply.point_xyzs_buffer, "<f4").reshape(-1, 3), points)
    own = np.array(reply.point_intensities, dtype=np.float32)
    np.testing.assert_array_equal(np.frombuffer(reply.point_intensities_buffer, "<f4"), own)
    assert own.shape == (len(points),) and ((own >= 0.0) & (own <= 1.0)).all()
    return points


def test_without_a_config_the_scenes_own_sensor_scans_and_points_are_those_of_the_end(client, drive, start_us, pair):
    reply = client.render_lidar(scan_request(start_us, pair))
    pose, velocity = motion_of(pair, LENGTH_US * 1e-6)
    world = drive.state(SECONDS)
    for track in [*world.actors]:
        world.remove(track)
    scan = world.scan(LIDAR, sensor_to_world=pose, velocity=velocity)
    expected = apply(inverse(pose_of(pair.end_pose)), scan.points())
    np.testing.assert_allclose(points_of(reply), expected, atol=1e-4)
    assert np.abs(expected - apply(inverse(pose), scan.points())).max() > 0.1


@pytest.mark.parametrize(("kind", "pattern"), [(0, pandar128), (1, at128)])
def test_a_named_sensor_fires_its_pattern(client, drive, start_us, pair, kind, pattern):
    config = sensorsim_pb2.LidarSpec(lidar_type=kind)
    points = points_of(client.render_lidar(scan_request(start_us, pair, lidar_config=config)))
    end = pose_of(pair.end_pose)
    ahead = apply(end, points)[:, 0]
    assert (np.abs(ahead - WALL_AT) < 1.5).mean() > 0.5, "most rays meet the wall"
    assert len(points) < pattern(0.1).rays.azimuths.size
    azimuths = np.abs(np.arctan2(points[:, 1], points[:, 0]))
    assert azimuths.max() < (1.06 if kind else np.pi)


def test_patterns_are_those_of_the_data_sheets():
    degrees = np.degrees(pandar128(0.1).rays.beam_elevations)
    assert pandar128(0.1).rays.shape == (128, 3600)
    assert degrees[0] == pytest.approx(14.4, abs=0.1) and degrees[-1] == pytest.approx(-25.0, abs=0.1)
    assert (np.abs(-np.diff(degrees)[25:89] - 0.125) < 1e-3).all()
    assert (np.abs(-np.diff(degrees)[[0, 24, 89, 126]] - 0.5) < 0.01).all()
    rays = at128(0.1).rays
    assert rays.shape == (128, 1200) and np.degrees(rays.beam_elevations[[0, -1]]) == pytest.approx([12.5, -12.9])
    assert np.degrees(rays.azimuths[0, [0, -1]]) == pytest.approx([59.95, -59.95])
    assert rays.offsets_s[0, [0, -1]] == pytest.approx([-0.05, 0.05], abs=1e-4)


def test_aggregated_scans_are_those_of_single_requests(client, start_us, pair):
    request = scan_request(start_us, pair)
    reply = client.render_aggregated(sensorsim_pb2.AggregatedRenderRequest(lidar_requests=[request]))
    assert [*reply.lidar_returns] == [client.render_lidar(request)] and not reply.rgb_returns


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"scene_id": "0001/street"}, "FAILED_PRECONDITION", "without LiDAR"),
        ({"scene_id": "0001/none"}, "NOT_FOUND", "0001/none"),
        ({"lidar_config": sensorsim_pb2.LidarSpec(lidar_type=7)}, "INVALID_ARGUMENT", "PANDAR128"),
        ({"frame_end_us": 5}, "INVALID_ARGUMENT", "lasts"),
        ({"sensor_pose": sensorsim_pb2.PosePair()}, "INVALID_ARGUMENT", "sensor_pose"),
    ],
)  # fmt: skip
def test_what_cannot_be_scanned_is_one_sentence(client, start_us, pair, change, code, words):
    request = scan_request(start_us, pair)
    for name, value in change.items():
        if hasattr(value, "SerializeToString"):
            getattr(request, name).CopyFrom(value)
        else:
            setattr(request, name, value)
    with pytest.raises(grpc.RpcError, match=words) as raised:
        client.render_lidar(request)
    assert raised.value.code().name == code


def test_many_scans_in_a_call_are_refused_before_any_is_rendered(client, start_us, pair):
    request = scan_request(start_us, pair)
    with pytest.raises(grpc.RpcError, match="asks for 17 scans; it may ask for 16") as raised:
        client.render_aggregated(sensorsim_pb2.AggregatedRenderRequest(lidar_requests=[request] * 17))
    assert raised.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
