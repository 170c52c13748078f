"""Images of the sensor service: what a request shows is what the drive renders."""

import numpy as np
import pytest
import torch
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from helpers.hand_made_drive import K
from helpers.hand_made_street import AHEAD, GONE, TURNING
from helpers.served_drives import (
    CAMERA,
    decoded,
    image_request,
    motion_of,
    object_of,
    pair_of,
    pinhole,
    pose_of,
    served,
)

import drivesplat
from drivesplat.scene.lens import pixels_of
from drivesplat.serve.camera_specs import camera_of
from drivesplat.serve.messages import wire
from drivesplat.serve.requests import RequestReader, ScenePlace

SCENE, SECONDS, LENGTH_US = "0001/street", 1.0, 40_000
ROLLING = {
    sensorsim_pb2.ROLLING_TOP_TO_BOTTOM: (0.0, 1.0), sensorsim_pb2.ROLLING_BOTTOM_TO_TOP: (0.0, -1.0),
    sensorsim_pb2.ROLLING_LEFT_TO_RIGHT: (1.0, 0.0), sensorsim_pb2.ROLLING_RIGHT_TO_LEFT: (-1.0, 0.0),
}  # fmt: skip


@pytest.fixture(scope="module")
def first_us(street) -> int:
    return min(frame.timestamp for frame in street.scene.frames)


@pytest.fixture(scope="module")
def frame(first_us) -> tuple[int, int]:
    """A frame whose middle is SECONDS after the first image."""
    middle = first_us + round(1e6 * SECONDS)
    return middle - LENGTH_US // 2, middle + LENGTH_US // 2


@pytest.fixture(scope="module")
def path(street) -> tuple[np.ndarray, np.ndarray]:
    """The recorded poses of the camera at the start and the end of the frame."""
    return tuple(street.camera_to_world(CAMERA, SECONDS + side * LENGTH_US * 0.5e-6) for side in (-1, 1))


def poses_of(street, track: str, times: tuple[float, ...]) -> list[np.ndarray]:
    (actor,) = (actor for actor in street.edited_actors if actor.id == track)
    return [*actor.poses(np.array(times))]


def recorded_objects(street, at: float = SECONDS) -> list:
    """All objects that are there, as recorded."""
    ends = at - LENGTH_US * 0.5e-6, at + LENGTH_US * 0.5e-6
    return [object_of(track, *poses_of(street, track, ends)) for track in street.state(at).actors]


def difference(image: np.ndarray, expected: np.ndarray) -> int:
    """The largest difference of a value."""
    return int(np.abs(image.astype(int) - expected.astype(int)).max())


# ---- poses, times and shutters


def test_a_global_shutter_shows_the_start_of_the_frame(client, street, frame, path):
    start = SECONDS - LENGTH_US * 0.5e-6
    request = image_request(SCENE, frame, path, recorded_objects(street))
    camera, pose = drivesplat.Camera(64, 48, K), pose_of(request.sensor_pose.start_pose)
    expected = street.render(camera, start, camera_to_world=pose).image
    assert difference(client.image(request), expected) <= 1
    assert difference(street.render(camera, SECONDS, camera_to_world=path[1]).image, expected) > 20


@pytest.mark.parametrize("shutter", ROLLING)
def test_a_recorded_frame_is_what_the_drive_renders_with_its_rolling_shutter(client, street, frame, path, shutter):
    aside = path[1] + np.outer(path[1][:, 0], [0.0, 0.0, 0.0, 1.0])  # 25 m/s to the right
    request = image_request(SCENE, frame, (path[0], aside), recorded_objects(street), pinhole(shutter))
    pose, velocity = motion_of(request.sensor_pose, LENGTH_US * 1e-6)
    readout = 1e-6 * LENGTH_US * np.array([*ROLLING[shutter], 0.0])
    camera = drivesplat.Camera(64, 48, K, readout_s=readout)
    expected = street.render(camera, SECONDS, camera_to_world=pose, velocity=velocity).image
    image = client.image(request)
    assert (np.abs(image.astype(int) - expected.astype(int)) > 1).mean() < 0.002  # velocities of objects are rounded
    still = street.render(drivesplat.Camera(64, 48, K), SECONDS, camera_to_world=pose).image
    assert difference(still, expected) > 20


def test_the_shutter_of_a_recorded_camera_is_advertised_and_replayed(client, results):
    drive = drivesplat.open(results / "0002/street", device="cpu")
    (camera,) = client.get_available_cameras(sensorsim_pb2.AvailableCamerasRequest(scene_id="0002")).available_cameras
    assert camera.intrinsics.shutter_type == sensorsim_pb2.ROLLING_TOP_TO_BOTTOM
    stamp = drive.scene.frames[2].timestamp
    frame, seconds = (stamp - 15_000, stamp + 15_000), drive.scene.seconds(stamp)
    poses = [drive.ego_to_world(seconds + side * 0.015) @ pose_of(camera.rig_to_camera) for side in (-1, 1)]
    objects = [
        object_of(track, *poses_of(drive, track, (seconds - 0.015, seconds + 0.015)))
        for track in drive.state(seconds).actors
    ]
    request = image_request("0002", frame, tuple(poses), objects, camera.intrinsics)
    expected = drive.render(drive.camera(CAMERA, exposure=True, rolling_shutter=True), seconds).image
    image = client.image(request)
    assert (np.abs(image.astype(int) - expected.astype(int)) > 2).mean() < 0.01


def test_a_frame_without_length_has_no_motion(client, street, first_us, path):
    stamp = first_us + round(1e6 * SECONDS)
    still = image_request(SCENE, (stamp, stamp), (path[0], path[0]), spec=pinhole(sensorsim_pb2.ROLLING_TOP_TO_BOTTOM))
    plain = image_request(SCENE, (stamp, stamp), (path[0], path[0]))
    assert difference(client.image(still), client.image(plain)) <= 1


@pytest.mark.parametrize("at", [0.0, 1.0])
def test_the_first_and_the_last_moment_are_within_the_recording(client, street, first_us, path, at):
    stamp = first_us + round(1e6 * street.duration * at)
    assert client.image(image_request(SCENE, (stamp, stamp), path)).shape == (48, 64, 3)


# ---- objects


def test_a_listed_object_is_drawn_where_it_is_listed(client, street, frame, path):
    shutter = pinhole(sensorsim_pb2.ROLLING_TOP_TO_BOTTOM)
    there = [pose + np.eye(4, k=3) * 1.5 for pose in poses_of(street, AHEAD, (0.98, 1.02))]
    listed = object_of(AHEAD, *there)
    request = image_request(SCENE, frame, path, [listed], shutter)
    world = street.state(SECONDS)
    assert TURNING in world.actors
    for track in {*world.actors} - {AHEAD}:
        world.remove(track)
    world.actors[AHEAD].set_motion(*motion_of(listed.pose_pair, LENGTH_US * 1e-6))
    pose, velocity = motion_of(request.sensor_pose, LENGTH_US * 1e-6)
    camera = drivesplat.Camera(64, 48, K, readout_s=np.array([0.0, LENGTH_US * 1e-6, 0.0]))
    expected = world.render(camera, camera_to_world=pose, velocity=velocity).image
    image = client.image(request)
    assert difference(image, expected) <= 1
    as_recorded = client.image(image_request(SCENE, frame, path, recorded_objects(street), shutter))
    assert difference(image, as_recorded) > 20


def test_an_object_that_is_not_listed_is_removed(client, street, frame, path):
    listed = [own for own in recorded_objects(street) if own.track_id != AHEAD]
    assert len(listed) < len(recorded_objects(street))
    request = image_request(SCENE, frame, path, listed)
    start = SECONDS - LENGTH_US * 0.5e-6
    world = street.state(start)
    world.remove(AHEAD)
    pose = pose_of(request.sensor_pose.start_pose)
    expected = world.render(drivesplat.Camera(64, 48, K), camera_to_world=pose).image
    assert difference(client.image(request), expected) <= 1


def test_a_track_without_gaussians_of_its_own_is_background(client, street, frame, path):
    parked = next(track for track in street.actors.index if not street.actors.loc[track, "editable"])
    plain = recorded_objects(street)
    away = [np.eye(4), np.eye(4)]
    listed = [*plain, object_of(parked, *away), object_of("unknown", *away)]
    with_others, without = (image_request(SCENE, frame, path, own) for own in (listed, plain))
    assert client.render_rgb(with_others).image_bytes == client.render_rgb(without).image_bytes


def test_an_object_may_be_listed_at_a_time_at_which_it_was_not_recorded(client, street, first_us, path):
    stamp = first_us + 2_300_000
    assert GONE not in street.state(2.3).actors
    ahead = path[0] @ np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 12.0], [0, 0, 0, 1]])
    shown, empty = (image_request(SCENE, (stamp, stamp), path, own) for own in ([object_of(GONE, ahead, ahead)], []))
    assert difference(client.image(shown), client.image(empty)) > 20


def test_a_request_without_objects_shows_none_or_those_recorded(client, results, street, frame, path):
    request = image_request(SCENE, frame, path)
    pose, start = pose_of(request.sensor_pose.start_pose), SECONDS - LENGTH_US * 0.5e-6
    camera, world = drivesplat.Camera(64, 48, K), street.state(start)
    recorded = world.render(camera, camera_to_world=pose).image
    for track in [*world.actors]:
        world.remove(track)
    removed = world.render(camera, camera_to_world=pose).image
    assert difference(removed, recorded) > 20
    assert difference(client.image(request), removed) <= 1
    with served(results / "0001/street", unlisted="recorded") as (_, other):
        request.scene_id = "0001"
        assert difference(other.image(request), recorded) <= 1


# ---- sizes, formats, exposure and masks


def test_half_the_resolution_halves_the_intrinsics(client, street, frame, path):
    request = image_request(SCENE, frame, path, recorded_objects(street), size=(32, 24))
    pose = pose_of(request.sensor_pose.start_pose)
    half = drivesplat.Camera(32, 24, K * np.array([[0.5], [0.5], [1.0]]))
    expected = street.render(half, SECONDS - LENGTH_US * 0.5e-6, camera_to_world=pose).image
    image = client.image(request)
    assert image.shape == (24, 32, 3) and difference(image, expected) <= 1


def test_every_format_has_the_same_image(client, results, frame, path):
    request = image_request(SCENE, frame, path)
    png = client.image(request)
    request.image_format = sensorsim_pb2.RGB_UINT8_PLANAR
    planar = np.frombuffer(client.render_rgb(request).image_bytes, np.uint8).reshape(3, 48, 64)
    np.testing.assert_array_equal(np.moveaxis(planar, 0, -1), png)
    request.image_format = sensorsim_pb2.JPEG
    default = client.render_rgb(request).image_bytes
    request.image_quality = 95
    assert client.render_rgb(request).image_bytes == default
    request.image_quality = 30
    coarse = client.render_rgb(request).image_bytes
    assert len(coarse) < len(default) and default[:2] == b"\xff\xd8"
    assert np.abs(decoded(default).astype(int) - png).mean() < 5.0
    with served(results / "0001/street", jpeg="device") as (_, other):
        request.scene_id, request.image_quality = "0001", 95
        on_device = decoded(other.render_rgb(request).image_bytes)
        assert np.abs(on_device.astype(int) - png).mean() < 5.0


def test_the_exposure_is_that_of_the_recorded_camera(frame, path):
    request = wire.RGBRenderRequest.FromString(image_request(SCENE, frame, path).SerializeToString())
    read = RequestReader(lambda scene, _: ScenePlace(scene)).image(request)
    assert read.placed(1.0).view(torch.device("cpu")).camera == CAMERA
    request.camera_intrinsics.logical_id = ""
    assert RequestReader(lambda scene, _: ScenePlace(scene)).image(request).camera.exposure_of is None


def test_ego_masks_are_offered_and_drawn_in_black(client, frame, path):
    masks = [own.ego_mask_id for own in client.get_available_ego_masks(common_pb2.Empty()).ego_mask_metadata]
    assert (CAMERA, SCENE) in {(mask.camera_logical_id, mask.rig_config_id) for mask in masks}
    assert "0002" not in {mask.rig_config_id for mask in masks}
    request = image_request(SCENE, frame, path)
    plain = client.image(request)
    request.insert_ego_mask = True
    masked = client.image(request)
    assert not masked[37:].any() and plain[37:].any()
    np.testing.assert_array_equal(masked[:36], plain[:36])


# ---- lenses


def ftheta(**fields) -> sensorsim_pb2.CameraSpec:
    given = {"principal_point_x": 30.0, "principal_point_y": 25.0, **fields}
    spec = pinhole()
    spec.ftheta_param.CopyFrom(sensorsim_pb2.FthetaCameraParam(**given))
    return spec


FORWARD = {"reference_poly": 2, "angle_to_pixeldist_poly": [0.0, 40.0, 0.0, -1.0]}
BACKWARD = {"reference_poly": 1, "pixeldist_to_angle_poly": [0.0, 0.025, 0.0, 1e-7]}


def own(spec) -> object:
    return wire.CameraSpec.FromString(spec.SerializeToString())


@pytest.mark.parametrize("scale", [(1, 1), (2, 3)])
@pytest.mark.parametrize("poly", [FORWARD, BACKWARD])
def test_ftheta_lenses_image_directions_where_their_definition_says(poly, scale):
    """At the angle a and the direction u in the image: principal point + [[c, d], [e, 1]] r(a) u, in pixels of the
    specification; (0, 0) is the corner of the image."""
    cde = sensorsim_pb2.LinearCde(linear_c=1.1, linear_d=0.05, linear_e=-0.03)
    camera = camera_of(own(ftheta(**poly, linear_cde=cde)), 64 * scale[0], 48 * scale[1], 0)
    angles, turns = np.meshgrid([0.1, 0.4, 0.6], np.arange(8) * np.pi / 4)
    angles, turns = angles.ravel(), turns.ravel()
    along = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    rays = np.column_stack([np.sin(angles)[:, None] * along, np.cos(angles)])
    if poly is FORWARD:
        radii = 40.0 * angles - angles**3
    else:
        table = np.linspace(0.0, 60.0, 60_001)
        radii = np.interp(angles, 0.025 * table + 1e-7 * table**3, table)
    places = np.array([30.0, 25.0]) + (radii[:, None] * along) @ np.array([[1.1, 0.05], [-0.03, 1.0]]).T
    np.testing.assert_allclose(pixels_of(camera.lens, rays) + 0.5, places * scale, atol=0.01)


def test_lenses_are_rendered_by_the_drive(client, street, frame, path):
    fisheye = pinhole(sensorsim_pb2.ROLLING_TOP_TO_BOTTOM)
    fisheye.opencv_fisheye_param.CopyFrom(
        sensorsim_pb2.OpenCVFisheyeCameraParam(
            principal_point_x=32, principal_point_y=24, focal_length_x=30, focal_length_y=31,
            radial_coeffs=[0.02, -0.01, 0.002, 0.0], max_angle=0.9,
        )
    )  # fmt: skip
    request = image_request(SCENE, frame, path, recorded_objects(street), fisheye)
    pose, velocity = motion_of(request.sensor_pose, LENGTH_US * 1e-6)
    intrinsics = np.array([[30.0, 0.0, 32.0], [0.0, 31.0, 24.0], [0.0, 0.0, 1.0]])
    camera = drivesplat.Camera(
        64, 48, intrinsics, readout_s=np.array([0.0, LENGTH_US * 1e-6, 0.0]), max_angle=0.9,
        distortion=np.array([0.02, -0.01, 0.002, 0.0]), distortion_model="fisheye",
    )  # fmt: skip
    expected = street.render(camera, SECONDS, camera_to_world=pose, velocity=velocity).image
    image = client.image(request)
    assert (np.abs(image.astype(int) - expected.astype(int)) > 2).mean() < 0.002
    assert not image[0, 0].any() and image[24, 32].any()
    distorted = pinhole()
    distorted.opencv_pinhole_param.radial_coeffs.extend([-0.2, 0.05, 0.01, 0.0, 0.0, 0.001])
    distorted.opencv_pinhole_param.tangential_coeffs.extend([0.001, -0.002])
    distorted.opencv_pinhole_param.thin_prism_coeffs.extend([0.001, 0.0, 0.002, 0.0])
    coefficients = [-0.2, 0.05, 0.001, -0.002, 0.01, 0.0, 0.0, 0.001, 0.001, 0.0, 0.002, 0.0]
    camera = drivesplat.Camera(64, 48, K, distortion=np.array(coefficients), distortion_model="opencv")
    request = image_request(SCENE, frame, path, recorded_objects(street), distorted)
    start = pose_of(request.sensor_pose.start_pose)
    expected = street.render(camera, SECONDS - LENGTH_US * 0.5e-6, camera_to_world=start).image
    assert difference(client.image(request), expected) <= 1


# ---- several images


def test_a_batch_has_the_images_of_single_requests(client, street, frame, path):
    shifted = tuple(pose + np.eye(4, k=3) * 0.7 for pose in path)
    requests = [
        image_request(SCENE, frame, path, recorded_objects(street)),
        image_request(SCENE, frame, shifted, recorded_objects(street), pinhole(sensorsim_pb2.ROLLING_LEFT_TO_RIGHT)),
        image_request("0002", frame, path),
        image_request("nowhere", frame, path),
    ]
    batch = sensorsim_pb2.BatchRGBRenderRequest()
    for number, request in enumerate(requests):
        batch.items.add(camera_name=f"camera {number}", request=request)
    reply = client.batch_render_rgb(batch)
    assert [item.camera_name for item in reply.items] == [f"camera {i}" for i in range(4)]
    assert [item.success for item in reply.items] == [True, True, True, False]
    assert reply.items[3].error_message.startswith("NOT_FOUND: ") and not reply.items[3].result.image_bytes
    for item, request in zip(reply.items[:3], requests, strict=False):
        assert item.result.image_bytes == client.render_rgb(request).image_bytes
    aggregated = client.render_aggregated(sensorsim_pb2.AggregatedRenderRequest(rgb_requests=requests[:2]))
    assert [own.image_bytes for own in aggregated.rgb_returns] == [item.result.image_bytes for item in reply.items[:2]]


def test_equal_pairs_of_poses_are_one_pose():
    pair = pair_of(np.eye(4), np.eye(4))
    pose, velocity = motion_of(pair, 0.1)
    np.testing.assert_allclose(pose, np.eye(4), atol=1e-7)
    assert not velocity.any()
