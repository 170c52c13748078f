"""Cameras and LiDARs of one's own on a trained drive: rolling shutters, lenses, scans, classes, batches and bands."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made_drive import K, drive_of
from helpers.hand_made_street import AHEAD, GONE, street_model, street_scene
from helpers.scanned_street import UNMEASURED, scan_records, scanned_street
from scipy.spatial.transform import Rotation

import drivesplat
from drivesplat.drive import world_state
from drivesplat.drive.cameras import mounted_velocity
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.drive.world_state import WorldState
from drivesplat.editing.scan_folder import scan_render_plan
from drivesplat.errors import DriveSplatError, RequestError, ResultError
from drivesplat.lidar.moved_sensor import steady_motion
from drivesplat.scene.lens import directions, pixels_of
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.export import ScanFolderJob

CAMERA, LIDAR, TIME, CAR = "CAM_FRONT", "LIDAR_TOP", 1.0, AHEAD
FORWARDS = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""World axes to the axes of a camera that looks along x."""
BEAMS = np.radians(np.linspace(-20.0, 10.0, 31))


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    return street_scene(tiny_scene)


@pytest.fixture(scope="module")
def drive(scene, tmp_path_factory) -> TrainedDrive:
    """The street of `scanned_street`, which renders LiDAR."""
    return drive_of(scene, scanned_street(scene), tmp_path_factory.mktemp("recorded"), scan_records(scene))


@pytest.fixture
def world(drive) -> WorldState:
    return drive.state(TIME)


def placed_ahead(world: WorldState, metres: float = 8.0) -> np.ndarray:
    """Places the car ahead of a camera high above the scene; returns the camera's pose."""
    there = np.eye(4)
    there[:3, 3] = [metres, 0.0, 30.0]
    world.actors[CAR].pose = there
    return rigid(FORWARDS.T, np.array([0.0, 0.0, 30.0]))


# ---- velocities


def test_the_velocity_of_the_vehicle_is_that_of_its_path(drive):
    step = 1e-3
    before, after = (drive.ego_to_world(TIME + sign * step) for sign in (-1, 1))
    now = drive.ego_to_world(TIME)
    found = drive.ego_velocity(TIME)
    np.testing.assert_allclose(now[:3, :3] @ found[:3], (after - before)[:3, 3] / (2 * step), atol=0.05)
    turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec() / (2 * step)
    np.testing.assert_allclose(now[:3, :3] @ found[3:], turn, atol=0.02)
    assert np.isfinite(drive.ego_velocity(0.0)).all() and np.isfinite(drive.ego_velocity(drive.duration)).all()


def test_a_sensors_velocity_follows_from_its_lever_arm():
    mount = rigid(Rotation.from_euler("xyz", [0.2, -0.4, 1.1]).as_matrix(), np.array([1.5, -0.5, 1.8]))
    velocity, step = np.array([8.0, 0.3, -0.1, 0.02, -0.05, 0.6]), 1e-5
    path = steady_motion(np.eye(4), velocity[:3], velocity[3:])
    before, after = path(np.array([-step, step])) @ mount
    found = mounted_velocity(velocity, mount)
    np.testing.assert_allclose(mount[:3, :3] @ found[:3], (after - before)[:3, 3] / (2 * step), atol=1e-5)
    turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec() / (2 * step)
    np.testing.assert_allclose(mount[:3, :3] @ found[3:], turn, atol=1e-5)


# ---- rolling shutters


def test_each_line_of_a_rolling_shutter_shows_its_own_time(world):
    """A camera that passes a standing car: each line is that of a camera which stands where this one is at its time."""
    pose, speed, readout = placed_ahead(world), 6.0, 0.1
    rolling = drivesplat.Camera(64, 48, K, readout_s=np.array([0.0, readout, 0.0]))
    sideways = [speed, 0.0, 0.0, 0.0, 0.0, 0.0]
    world.actors[CAR].set_motion(world.actors[CAR].pose, np.zeros(6))
    image = world.render(rolling, camera_to_world=pose, velocity=sideways).rgb
    still = world.render(rolling, camera_to_world=pose).rgb
    plain = drivesplat.Camera(64, 48, K)
    for line in (19, 24, 29):
        at_line = pose.copy()
        at_line[:3, 3] += pose[:3, 0] * speed * readout * ((line + 0.5) / 48 - 0.5)
        expected = world.render(plain, camera_to_world=at_line).rgb[line]
        torch.testing.assert_close(image[line], expected, atol=0.04, rtol=0)
    assert (image[19] - still[19]).abs().max() > 0.1
    whole = world.render(plain, camera_to_world=pose).rgb
    torch.testing.assert_close(still[:36], whole[:36], atol=1e-5, rtol=0)  # below it others drive


def test_an_object_in_motion_is_sheared_as_by_a_camera_that_moves(world):
    pose, speed = placed_ahead(world), 25.0
    rolling = drivesplat.Camera(64, 48, K, readout_s=np.array([0.0, 0.1, 0.0]))
    there = world.actors[CAR].pose
    world.actors[CAR].set_motion(there, np.zeros(6))
    passing = world.render(rolling, camera_to_world=pose, velocity=[speed, 0, 0, 0, 0, 0], outputs=["instance"])
    world.actors[CAR].set_motion(there, [0.0, speed, 0.0, 0.0, 0.0, 0.0])  # to its left, which is the camera's left
    moving = world.render(rolling, camera_to_world=pose, outputs=["instance"])
    same = (passing.instance == moving.instance).float().mean()
    assert same > 0.999
    world.actors[CAR].set_motion(there, np.zeros(6))
    standing = world.render(rolling, camera_to_world=pose, outputs=["instance"])
    assert (standing.instance != moving.instance).sum() > 10


# ---- lenses

LENSES = {
    "opencv": [-0.2, 0.05, 0.001, -0.002, 0.0], "fisheye": [0.02, -0.01, 0.002, 0.0], "mei": [0.8, 0.01, 0.0, 0.0, 0.0],
    "angle_to_radius": [40.0, 0.0, -1.0], "radius_to_angle": [0.025, 0.0, 1e-7],
}  # fmt: skip


@pytest.mark.parametrize("model", LENSES)
def test_the_direction_of_every_pixel_is_imaged_at_the_pixel(model):
    lens = drivesplat.Camera(64, 48, K, distortion=np.array(LENSES[model]), distortion_model=model).lens
    rays = directions(lens)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-9)
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    np.testing.assert_allclose(
        pixels_of(lens, rays.reshape(-1, 3)), np.stack([columns, rows], -1).reshape(-1, 2), atol=0.05
    )


def test_a_lens_without_distortion_shows_the_pinhole_image(world):
    pose = placed_ahead(world)
    plain, lens = (
        drivesplat.Camera(64, 48, K),
        camera_with([0.0] * 5, "opencv"),
    )
    outputs = ["rgb", "alpha", "depth", "instance", "semantic", "valid"]
    expected, found = (world.render(one, camera_to_world=pose, outputs=outputs) for one in (plain, lens))
    torch.testing.assert_close(found.rgb, expected.rgb, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.alpha, expected.alpha, atol=1e-3, rtol=0)
    assert (found.instance == expected.instance).float().mean() > 0.999 and found.valid.all()
    rays = torch.from_numpy(directions(lens.lens))
    by_axis = found.depth * rays[..., 2]
    torch.testing.assert_close(by_axis.float(), expected.depth, atol=1e-3, rtol=1e-3)


def test_a_fisheye_sees_objects_beside_and_behind_it(world):
    """A lens of 260 degrees, from the faces of a cube: the car appears where the lens images its direction."""
    focal = 32.0 / np.radians(130.0)
    k = np.array([[focal, 0.0, 32.0], [0.0, focal, 32.0], [0.0, 0.0, 1.0]])
    camera = drivesplat.Camera(64, 64, k, distortion=np.zeros(4), distortion_model="fisheye")
    pose = rigid(FORWARDS.T, np.array([0.0, 0.0, 30.0]))
    for azimuth in (0.0, 60.0, -95.0):
        there = rigid(np.eye(3), np.array([0.0, 0.0, 30.0]))
        there[:2, 3] = 8.0 * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
        world.actors[CAR].pose = there
        view = world.render(camera, camera_to_world=pose, outputs=["instance", "depth", "valid"])
        rows, columns = np.nonzero(view.arrays()["instance"] == 0)
        expected = pixels_of(camera.lens, (there[:3, 3] - pose[:3, 3])[None] @ pose[:3, :3])[0]
        assert len(rows) and np.hypot(columns.mean() - expected[0], rows.mean() - expected[1]) < 4.0
        assert abs(float(np.median(view.arrays()["depth"][rows, columns])) - 8.0) < 3.0
        assert view.valid[32, 32] and not view.valid[0, 0], "the corners are beyond the lens"


# ---- classes, covered pixels, batches and bands


def test_classes_agree_with_objects_and_the_sky(world):
    pose = placed_ahead(world)
    view = world.render(drivesplat.Camera(64, 48, K), camera_to_world=pose, outputs=["instance", "semantic", "alpha"])
    assert view.classes[0] == "sky" and {"background", "car"} <= set(view.classes)
    car, shown = view.classes.index("car"), view.instance == 0
    assert (view.semantic[shown] == car).all() and (view.semantic[view.alpha < 0.4] == 0).all()
    world.remove(CAR)
    gone = world.render(drivesplat.Camera(64, 48, K), camera_to_world=pose, outputs=["semantic"])
    assert (gone.semantic[shown] == 0).float().mean() > 0.9


def test_pixels_of_the_vehicles_own_body_are_not_valid(world, drive):
    camera = drivesplat.Camera(64, 48, K, covered=(((0.0, 0.5), (1.0, 0.5), (1.0, 1.0), (0.0, 1.0)),))
    view = world.render(camera, camera_to_world=np.eye(4), outputs=["valid"])
    assert view.valid[:23].all() and not view.valid[25:].any()
    assert drive.render(CAMERA, TIME, outputs=["valid"]).valid.float().mean() > 0.5


def test_cameras_together_are_the_same_as_one_by_one(world, drive):
    cameras = [CAMERA, drive.camera(CAMERA).resized(40)]
    for ego in (None, drive.ego_to_world(TIME + 0.2)):
        together = world.render(cameras, ego_to_world=ego, outputs=["rgb", "instance"])
        for camera, view in zip(cameras, together, strict=True):
            alone = world.render(camera, ego_to_world=ego, outputs=["rgb", "instance"])
            assert torch.equal(alone.rgb, view.rgb) and torch.equal(alone.instance, view.instance)
    assert len(drive.render(cameras, TIME)) == 2


@pytest.mark.parametrize("readout", [np.zeros(3), np.array([0.0, 0.05, 0.01]), np.array([-0.05, 0.0, 0.0])])
def test_an_image_in_bands_is_the_image(world, drive, readout, monkeypatch):
    known = drive.camera(CAMERA)
    camera = drivesplat.Camera(known.width, known.height, known.K, known.camera_to_ego, readout_s=readout)
    outputs = ["rgb", "depth", "instance", "valid"]
    whole = world.render(camera, outputs=outputs, velocity=[8.0, 0, 0, 0, 0, 0.3])
    monkeypatch.setattr(world_state, "MAX_PIXELS", 7 * known.width)
    bands = world.render(camera, outputs=outputs, velocity=[8.0, 0, 0, 0, 0, 0.3])
    assert bands.rgb.shape == whole.rgb.shape
    torch.testing.assert_close(bands.rgb, whole.rgb, atol=0.02, rtol=0)
    assert (bands.instance == whole.instance).float().mean() > 0.99 and torch.equal(bands.valid, whole.valid)


# ---- scans


def test_a_scan_at_a_recorded_time_is_that_of_scan_folders(drive):
    sweep = drive.recording.nearest_scan(LIDAR, TIME)
    job = ScanFolderJob.model_validate({"eval_camera": CAMERA, "formats": ["npz"]})
    plan = scan_render_plan(drive.scene, drive.model, [sweep], job, "a test")
    (expected,) = plan.simulated(drive.beam_spread)
    found = drive.scan(LIDAR, sweep.seconds)
    arrays = found.arrays()
    np.testing.assert_array_equal(arrays["returned"], expected.returned)
    np.testing.assert_allclose(arrays["range"], expected.rendered.ranges, atol=2e-3)
    np.testing.assert_allclose(arrays["intensity"], expected.rendered.intensities, atol=2e-3)
    np.testing.assert_allclose(found.points(), expected.places()[0], atol=5e-3)
    ids = [actor.id for actor in plan.actors]
    assert (arrays["instance"] >= 0).any() == (expected.objects == ids.index(CAR)).any()


def test_rays_that_say_nothing_in_the_recording_do_not_return(drive):
    """As in scan folders: rays that meet the vehicle itself. Here a car stands where they look."""
    world = drive.state(TIME)
    pose = world.scan(LIDAR).sensor.sensor_to_world
    behind = pose.copy()
    behind[:3, 3] -= 6.0 * pose[:3, 0]
    world.actors[CAR].pose = behind
    arrays = world.scan(LIDAR).arrays()
    assert (arrays["instance"][:, UNMEASURED] == 0).any() and (arrays["probability"][:, UNMEASURED] > 0.5).any()
    assert not arrays["returned"][:, UNMEASURED].any() and arrays["returned"][arrays["instance"] == 0].any()


def test_a_pattern_of_ones_own_measures_an_object_where_it_stands(world):
    placed_ahead(world)
    lidar = drivesplat.Lidar.spinning(BEAMS, azimuth_steps=360)
    pose = rigid(np.eye(3), np.array([0.0, 0.0, 30.0]))
    scan = world.scan(lidar, sensor_to_world=pose)
    arrays = scan.arrays()
    met = arrays["instance"] == 0
    assert met.any() and (np.abs(lidar.rays.azimuths[met]) < 0.4).all()
    length = float(world.actors[CAR].size[0])
    assert (np.abs(arrays["range"][met] - 8.0) < length).all()
    points = scan.points("sensor")
    np.testing.assert_allclose(points + pose[:3, 3], scan.points(), atol=1e-9)
    assert len(points) == arrays["returned"].sum()


def test_the_sensor_moves_during_a_revolution(world):
    """The car stands ahead; a sensor that drives towards it meets it nearer in the later half of its revolution."""
    placed_ahead(world, 12.0)
    world.actors[CAR].set_motion(world.actors[CAR].pose, np.zeros(6))
    lidar = drivesplat.Lidar.spinning(BEAMS, azimuth_steps=360, revolution_s=0.2)
    pose = rigid(np.eye(3), np.array([0.0, 0.0, 30.0]))
    standing = world.scan(lidar, sensor_to_world=pose)
    driving = world.scan(lidar, sensor_to_world=pose, velocity=[20.0, 0, 0, 0, 0, 0])
    both = (standing.instance == 0) & (driving.instance == 0)
    offsets = torch.from_numpy(lidar.rays.offsets_s)[both]
    nearer = (standing.range - driving.range)[both]
    assert both.sum() > 5 and torch.corrcoef(torch.stack([offsets, nearer]))[0, 1] > 0.5
    assert np.abs(np.median(driving.points()[:, 0]) - np.median(standing.points()[:, 0])) < 1.0


def test_a_revolution_goes_round_once_in_its_time():
    lidar = drivesplat.Lidar.spinning([0.0, 0.1], azimuth_steps=8, revolution_s=0.1)
    azimuths, offsets = lidar.rays.azimuths[0], lidar.rays.offsets_s[0]
    assert (np.diff(azimuths) < 0).all() and (np.diff(offsets) > 0).all(), "clockwise from behind"
    assert offsets[0] == pytest.approx(-0.05 + 0.1 / 16) and offsets[-1] == pytest.approx(0.05 - 0.1 / 16)
    other = drivesplat.Lidar.spinning([0.0], azimuth_steps=8, clockwise=False)
    assert (np.diff(other.rays.azimuths[0]) > 0).all()


def test_a_lidar_rides_on_the_vehicle(drive):
    mount = drive.lidar(LIDAR, TIME).sensor_to_ego
    ego = drive.ego_to_world(TIME)
    own = drivesplat.Lidar.spinning(BEAMS, azimuth_steps=90, sensor_to_ego=mount)
    for placed in (drive.scan(own, TIME), drive.scan(LIDAR, TIME, ego_to_world=ego)):
        np.testing.assert_allclose(placed.sensor.sensor_to_world, ego @ mount, atol=1e-6)
    moving = drive.scan(own, TIME).sensor
    speed = np.linalg.norm(drive.ego_velocity(TIME)[:3])
    assert np.linalg.norm(moving.linear) == pytest.approx(speed, abs=0.3)
    aside = drive.edited([{"ego": {"lateral": 1.0}}])
    late = drive.duration - 0.5
    edited, recorded = (one.scan(LIDAR, late).sensor.sensor_to_world for one in (aside, drive))
    np.testing.assert_allclose((inverse(recorded) @ edited)[:3, 3], [0.0, 1.0, 0.0], atol=0.05)


def test_a_model_without_lidar_and_a_drive_without_scans_say_so(drive, scene):
    blind = dataclasses.replace(drive, model=street_model())
    with pytest.raises(ResultError, match="trained without LiDAR"):
        blind.scan(LIDAR, TIME)
    nowhere = dataclasses.replace(drive.recording, scans_file=drive.recording.scans_file.with_name("none.npz"))
    with pytest.raises(RequestError, match=r"none\.npz"):
        dataclasses.replace(drive, recording=nowhere).scan(LIDAR, TIME)


# ---- errors

POSE = np.eye(4)


def camera_with(coefficients: list[float], model: str, **lens) -> "drivesplat.Camera":
    arrays = {name: np.array(values) for name, values in {**lens, "distortion": coefficients}.items()}
    return drivesplat.Camera(64, 48, K, distortion_model=model, **arrays)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda drive: drive.scan("LIDAR_X", TIME), RequestError, ["LIDAR_X", LIDAR]),
        (lambda drive: drive.scan(LIDAR, 99.0), RequestError, ["99"]),
        (lambda drive: drive.scan(LIDAR, TIME, velocity=[1.0]), RequestError, ["velocity", "6"]),
        (lambda drive: drive.scan(drivesplat.Lidar.spinning([0.0], 8), TIME), RequestError, ["sensor_to_ego"]),
        (lambda drive: drive.scan(LIDAR, TIME, ego_to_world=POSE, sensor_to_world=POSE), RequestError, ["one pose"]),
        (lambda drive: drive.state(TIME).actors["f8cf_none"], RequestError, ["f8cf_none", CAR]),
        (lambda drive: drive.state(0.0).actors[GONE], RequestError, [GONE, "at this time"]),
        (lambda drive: drive.render([CAMERA], TIME, camera_to_world=np.eye(4)), RequestError, ["one camera"]),
        (lambda drive: drive.render(CAMERA, TIME, velocity=[np.inf] * 6), RequestError, ["velocity"]),
        (lambda drive: drive.state(TIME).actors[CAR].set_motion(np.eye(4), [0.0]), RequestError, [CAR, "6"]),
        (lambda _: drivesplat.Lidar.spinning([100.0], 8), RequestError, ["radians"]),
        (lambda _: drivesplat.Lidar.spinning([0.0], 0), RequestError, ["azimuth_steps"]),
        (lambda _: drivesplat.Lidar.spinning([0.0], 8, revolution_s=-1.0), RequestError, ["revolution_s"]),
        (lambda _: drivesplat.Lidar.spinning([0.0], 8, beam_spread=(0.3, 0.3)), RequestError, ["beam_spread"]),
        (lambda _: camera_with([0.1], "opencv"), RequestError, ["4 or 5"]),
        (lambda _: camera_with([np.nan] * 4, "fisheye"), RequestError, ["finite"]),
    ],
)  # fmt: skip
def test_what_sensors_cannot_be_is_one_sentence(call, error, words, drive):
    with pytest.raises(error) as raised:
        call(drive)
    assert all(word in str(raised.value) for word in words), raised.value
    assert isinstance(raised.value, DriveSplatError) and "\n" not in str(raised.value)


def test_a_recorded_camera_keeps_to_its_own_path_also_as_a_camera_of_ones_own(drive):
    by_name, own = drive.placed_camera(CAMERA, TIME), drive.placed_camera(drive.camera(CAMERA).resized(32), TIME)
    np.testing.assert_array_equal(by_name.camera_to_world, own.camera_to_world)


def test_objects_that_are_not_editable_and_removed_ones_say_so(drive, world):
    parked = next(iter(set(drive.actors.index) - set(world.actors) - {GONE}))
    with pytest.raises(RequestError, match="not editable"):
        _ = world.actors[parked]
    world.remove(CAR)
    with pytest.raises(RequestError, match="removed"):
        _ = world.actors[CAR]
    assert CAR not in repr(world.actors)


def test_rays_of_a_recorded_lidar_are_a_copy(drive):
    before = drive.scan(LIDAR, TIME).range
    drive.lidar(LIDAR, TIME).rays.azimuths[:] = 0.0
    assert torch.equal(drive.scan(LIDAR, TIME).range, before)


def test_boxes_of_a_distorted_camera_are_refused(world):
    lens = camera_with([0.0] * 4, "fisheye")
    with pytest.raises(RequestError, match="boxes"):
        world.render(lens, camera_to_world=np.eye(4), outputs=["boxes"])
