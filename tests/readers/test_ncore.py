"""Clips of NCore, written by NVIDIA's library: the drive of nuScenes' tables gives the same scene; poses, lenses, rays
and boxes are those that were recorded."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import drives
from helpers.drives import START_US, turning_world
from helpers.ncore_clips import (
    LIDAR,
    NAME,
    PLACE,
    READOUT_US,
    SWEEP_US,
    Recording,
    pinhole,
    tables_recording,
    turning_recording,
    write_clip,
    write_metadata,
)
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.extract import extract_scene
from drivesplat.preprocess.scans import scan_records
from drivesplat.readers.drive.write import write_drive
from drivesplat.readers.ncore.calibration import camera_of
from drivesplat.readers.ncore.layout import camera_names, find_root, outline, table_files
from drivesplat.readers.ncore.store_metadata import METADATA, store_metadata
from drivesplat.readers.ncore.tracks import object_class
from drivesplat.readers.sweeps import read_returns, read_scan
from drivesplat.scene.lens import pixels_of
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.recorded_shutters import shutter_of
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scene import Scene, read_scene, write_scene
from drivesplat.settings.extract import SceneSource

pytest.importorskip("ncore")
pytestmark = pytest.mark.usefixtures("uncompared")

STORES = {"itar": {}, "directory": {"store": "directory"}, "separate": {"separate": True, "manifest": False}}


def source(**changes: Any) -> SceneSource:
    given = {"dataset": "mine", "reader": "ncore", "version": "", "scene": NAME, "cameras": ("front",)}
    return drives.source(**{**given, "sweeps": True, "lidar_sweeps": True, **changes})


@pytest.fixture(scope="module")
def tables(tmp_path_factory) -> Scene:
    """The tiny drive as nuScenes' tables give it."""
    root = drives.write_world(tmp_path_factory.mktemp("tables"), drives.World(key_frames=4, lidar_between=1))
    return drives.scene_at(root, lidar_sweeps=True)


@pytest.fixture(scope="module", params=STORES)
def same(request, tables, tmp_path_factory) -> Scene:
    """The same drive from a clip."""
    root = write_clip(tmp_path_factory.mktemp("clip"), tables_recording(tables), **STORES[request.param])
    return extract_scene(source(), root, None, tmp_path_factory.mktemp("results"))


def test_the_scene_is_that_of_the_tables(same, tables, tmp_path):
    """Poses within 0.1 micrometres, intrinsics within single precision. All sweeps of a clip are key frames."""
    assert same.poses == "ncore" and same.version == "v4" and NAME in same.description
    np.testing.assert_array_equal(same.key_frame_timestamps, [sweep.timestamp for sweep in tables.sweeps])
    first = tables.sweeps[0].sensor_to_world[:3, 3] - drives.LIDAR_AT + tables.origin
    np.testing.assert_allclose(same.origin, first, atol=1e-7)
    shift = tables.origin - same.origin
    known = {frame.timestamp: frame for frame in tables.frames}
    assert len(same.frames) == len(known)
    for frame in same.frames:
        other = known[frame.timestamp]
        for name in ("camera_to_world", "ego_to_world"):
            np.testing.assert_allclose(getattr(frame, name), moved(getattr(other, name), shift), atol=1e-7)
        np.testing.assert_allclose(frame.intrinsics, other.intrinsics, rtol=1e-6)
        assert Path(frame.image_path).read_bytes() == Path(other.image_path).read_bytes()
        assert (frame.width, frame.height) == (other.width, other.height)
    (camera,) = same.cameras
    assert (camera.distortion_model, camera.readout_direction) == ("none", "down")
    assert camera.readout_s == pytest.approx(1e-6 * READOUT_US)
    write_scene(tmp_path / "scene.json", same)
    for frame, again in zip(same.frames, read_scene(tmp_path / "scene.json").frames, strict=True):
        np.testing.assert_array_equal(frame.camera_velocity, again.camera_velocity)


def test_points_are_those_of_the_tables(same, tables):
    """Within a tenth of a millimetre: directions and distances are of single precision."""
    for mine, theirs in zip(same.sweeps, tables.sweeps, strict=True):
        assert mine.timestamp == theirs.timestamp
        mine_returns, their_returns = read_returns(mine), read_returns(theirs)
        np.testing.assert_allclose(mine_returns.points, their_returns.points, atol=1e-4)
        np.testing.assert_allclose(mine_returns.intensity, their_returns.intensity)
        shifted = moved(theirs.sensor_to_world, tables.origin - same.origin)
        np.testing.assert_allclose(mine.sensor_to_world, shifted, atol=1e-7)


def test_tracks_are_those_of_the_tables(same, tables):
    shift = tables.origin - same.origin
    assert [track.id for track in same.tracks] == [track.id for track in tables.tracks]
    for mine, theirs in zip(same.tracks, tables.tracks, strict=True):
        assert (mine.object_class, mine.category) == (theirs.object_class, theirs.category)
        np.testing.assert_allclose(mine.size, theirs.size)
        at = {int(time): pose for time, pose in zip(mine.timestamps, mine.object_to_world, strict=True)}
        for time, pose in zip(theirs.timestamps.tolist(), theirs.object_to_world, strict=True):
            np.testing.assert_allclose(at[time], moved(pose, shift), atol=1e-7)
        assert len(at) == 2 * len(theirs.timestamps) - 1, "interpolated at the key frames between"


def moved(pose: np.ndarray, shift: np.ndarray) -> np.ndarray:
    return rigid(pose[:3, :3], pose[:3, 3] + shift)


@pytest.mark.parametrize("store", STORES)
def test_planning_knows_what_a_clip_holds(store, tables, tmp_path):
    root = write_clip(tmp_path / "clips" / "folder", tables_recording(tables), **STORES[store]).parent
    assert find_root(str(root), "") == root and camera_names(root, "") == ["front"]
    for scene in (NAME, "folder", "clip_00"):
        found = outline(root, "", scene)
        assert found.cameras["front"].images == len(tables.frames)
        assert (found.cameras["front"].width, found.cameras["front"].height) == (96, 54)
        assert list(found.key_frames) == [sweep.timestamp for sweep in tables.sweeps]
        assert found.sweeps == len(tables.sweeps) and found.without_beams == ["top"]
    files = table_files(root, "", NAME)
    assert all(file.is_file() for file in files)
    assert (root / "folder" / f"{NAME}.json" in files) == STORES[store].get("manifest", True)


# A drive that turns


@pytest.fixture(scope="module")
def turning(tmp_path_factory) -> tuple[Any, Recording, dict[int, np.ndarray], Scene]:
    world = turning_world(PLACE)
    recording, hits = turning_recording(world, START_US)
    root = write_clip(tmp_path_factory.mktemp("turning"), recording)
    return world, recording, hits, extract_scene(source(), root, None, tmp_path_factory.mktemp("turning_results"))


def test_images_have_the_exact_poses_of_their_start_and_end(turning):
    world, recording, _, scene = turning
    mount, _, images = recording.cameras["front"]
    by_token = {frame.token: frame for frame in scene.frames}
    ends = [end for _, end, _, _ in images]
    assert set(by_token) <= {f"front/{end}" for end in ends} and len(by_token) >= 8
    for token, frame in by_token.items():
        end = int(token.rpartition("/")[2])
        start = end - READOUT_US
        assert frame.timestamp == (start + end) // 2
        shutter = shutter_of(scene, frame)
        np.testing.assert_allclose(shutter.readout_s, [0.0, 1e-6 * READOUT_US, 0.0], atol=1e-9)
        for time, share in ((start, -0.5), (end, 0.5)):  # both are times of stored poses
            step = share * 1e-6 * READOUT_US * shutter.velocity
            turned = Rotation.from_rotvec(step[3:]).as_matrix()
            at = frame.camera_to_world @ rigid(turned, step[:3])
            np.testing.assert_allclose(at, moved(world.ego(time) @ mount, -scene.origin), atol=1e-6)


def test_rays_end_where_they_were_cast(turning):
    """Each at its own time, while the vehicle turns: within 0.2 mm, which is the interpolation of poses at 100 Hz."""
    _, _, hits, scene = turning
    for sweep in scene.sweeps:
        ends = hits[int(sweep.token.rpartition("/")[2])].reshape(-1, 3)
        there = np.isfinite(ends[:, 0])
        returns = read_returns(sweep)
        points = apply(sweep.sensor_to_world, returns.points) + scene.origin
        assert there.sum() == len(points) > 300
        assert np.abs(points - ends[there]).max() < 2e-4
        assert np.abs(returns.offsets_s).max() <= 0.5e-6 * SWEEP_US
        np.testing.assert_array_equal(returns.rings, np.repeat(np.arange(16), 90)[there])


def test_scans_have_all_rays_with_their_times(turning):
    _, recording, hits, scene = turning
    model = recording.lidars["lidar"][1]
    for sweep, rays in zip(scene.sweeps, recording.lidars["lidar"][2], strict=True):
        scan = read_scan(sweep, None)
        assert scan.rays.shape == (16, 90) and scan.intensities is not None
        np.testing.assert_array_equal(scan.returned, np.isfinite(hits[rays.end][..., 0]))
        np.testing.assert_allclose(scan.ranges[scan.returned], rays.distance[np.isfinite(rays.distance)], rtol=1e-6)
        offsets = (rays.times.reshape(16, 90) - sweep.timestamp) * 1e-6
        np.testing.assert_allclose(scan.rays.offsets_s, offsets, atol=1e-8)
        turned = model.column_azimuths_rad[None] + model.row_azimuth_offsets_rad[:, None]
        np.testing.assert_allclose(np.exp(1j * scan.rays.azimuths), np.exp(1j * turned), atol=1e-6)
        assert set(np.unique(scan.intensities[scan.returned])) == {np.float32(0.25)}
    assert scene.lidars[0].azimuth_steps == 90 and len(scene.lidars[0].beam_elevations) == 16


def test_rays_without_an_entry_are_known_by_the_model(turning, tmp_path):
    """Converters leave out rays without a return: these have the angles of the model and the times of their columns."""
    _, recording, _, whole = turning
    mount, model, sweeps = recording.lidars["lidar"]
    kept = []
    for rays in sweeps:
        hit = np.isfinite(rays.distance[0])
        kept.append(
            type(rays)(
                rays.start, rays.end, rays.direction[hit], rays.times[hit], rays.distance[:, hit],
                rays.intensity[:, hit], rays.elements[hit],
            )
        )  # fmt: skip
    alone = Recording(recording.times, recording.rig_to_global, lidars={"lidar": (mount, model, kept)})
    scene = extract_scene(source(cameras=()), write_clip(tmp_path / "clip", alone), None, tmp_path / "out")
    for mine, theirs in zip(scene.sweeps, whole.sweeps, strict=True):
        scan, other = read_scan(mine, None), read_scan(theirs, None)
        np.testing.assert_array_equal(scan.returned, other.returned)
        np.testing.assert_allclose(scan.rays.offsets_s, other.rays.offsets_s, atol=2e-6)
        np.testing.assert_allclose(scan.rays.elevations, other.rays.elevations, atol=1e-6)
    assert not scan.returned.all()


def test_boxes_are_where_they_were_at_the_key_frames(turning):
    """Observed 7 ms after each key frame, in the frame of the LiDAR at the end of the sweep."""
    world, _, _, scene = turning
    assert [track.object_class for track in scene.tracks] == [
        ObjectClass.CAR, ObjectClass.TRUCK, ObjectClass.PEDESTRIAN
    ]  # fmt: skip
    for thing, track in zip(world.things, scene.tracks, strict=True):
        np.testing.assert_array_equal(track.timestamps, scene.key_frame_timestamps)
        for time, pose in zip(track.timestamps.tolist(), track.object_to_world, strict=True):
            np.testing.assert_allclose(pose, moved(world.box(thing, time), -scene.origin), atol=1e-6)
        np.testing.assert_allclose(track.size, thing.size)


def test_the_world_is_that_of_world_global(turning):
    world, _, _, scene = turning
    middle = int(scene.key_frame_timestamps[0])
    np.testing.assert_allclose(scene.origin, world.ego(middle)[:3, 3], atol=2e-4)
    assert "begins at" in scene.description and "world_global" in scene.description


@pytest.mark.parametrize("kind", ["ecef", "none"])
def test_without_an_upright_world_global_the_axes_are_those_of_the_world(kind, turning, tmp_path):
    world, recording, _, _ = turning
    tilt = rigid(Rotation.from_euler("xyz", [1.2, 0.3, 0.8]).as_matrix(), np.array([4.1e6, 8.4e5, 4.8e6]))
    poses = tilt @ inverse(recording.rig_to_global[0]) @ recording.rig_to_global
    if kind == "none":
        poses = inverse(tilt) @ poses
    changed = Recording(recording.times, poses, recording.cameras, recording.lidars, recording.boxes, kind == "ecef")
    scene = extract_scene(source(), write_clip(tmp_path / "clip", changed), None, tmp_path / "out")
    first, middle = world.ego(START_US), int(scene.key_frame_timestamps[0])
    np.testing.assert_allclose(scene.origin, (inverse(first) @ world.ego(middle))[:3, 3], atol=2e-4)
    assert ("world_global" in scene.description) == (kind == "ecef")
    for thing, track in zip(world.things, scene.tracks, strict=True):
        expected = inverse(first) @ world.box(thing, int(track.timestamps[2]))
        np.testing.assert_allclose(track.object_to_world[2], moved(expected, -scene.origin), atol=2e-6)


def test_single_precision_poses_stay_rigid(turning, tmp_path):
    _, recording, _, exact = turning
    single = Recording(**{**vars(recording), "dtype": "float32"})
    scene = extract_scene(source(), write_clip(tmp_path / "clip", single), None, tmp_path / "out")
    for mine, theirs in zip(scene.frames, exact.frames, strict=True):
        np.testing.assert_allclose(mine.camera_to_world, theirs.camera_to_world, atol=1e-5)
        turn = mine.camera_to_world[:3, :3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)


def test_scans_of_a_clip_are_resolved(turning):
    from drivesplat.settings.images import HoldoutSettings
    from drivesplat.settings.scans import ScanSettings, ScansJob

    job = ScansJob(scans=ScanSettings(), on_missing="stop", own_car_radius=2.0, holdout=HoldoutSettings())
    records = scan_records(turning[3], job).scans
    assert len(records) == 5 and all(record.scan.returned.any() for record in records)
    assert max(int(record.objects.max()) for record in records) >= 0, "some rays meet boxes"


def test_as_a_drive_folder_a_clip_keeps_its_velocities_and_returns(turning, tmp_path):
    scene = turning[3]
    write_drive(scene, tmp_path / "folder")
    again = extract_scene(source(reader="drive", scene="folder"), tmp_path)
    for mine, theirs in zip(again.frames, scene.frames, strict=True):
        for name in ("camera_velocity", "camera_to_world", "ego_to_world"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
    for mine, theirs in zip(again.sweeps, scene.sweeps, strict=True):
        np.testing.assert_allclose(read_returns(mine).points, read_returns(theirs).points, atol=1e-5)


def test_a_frame_range_and_key_frames_alone(turning, tmp_path):
    _, recording, _, whole = turning
    root = write_clip(tmp_path / "clip", recording)
    scene = extract_scene(source(frames=(1, 4), sweeps=False, lidar_sweeps=False), root, None, tmp_path / "out")
    np.testing.assert_array_equal(scene.key_frame_timestamps, whole.key_frame_timestamps[1:4])
    assert [frame.sample_index for frame in scene.frames] == [0, 1, 2] and scene.key_frame_range == [1, 4]
    assert len(scene.sweeps) == 3 and all(frame.is_key_frame for frame in scene.frames)
    assert len(list((tmp_path / "out" / "images").rglob("*.png"))) == 3


def test_recordings_beyond_the_path_are_left_out(turning, tmp_path):
    _, recording, _, whole = turning
    root = write_clip(tmp_path / "clip", recording, store="directory", manifest=False)
    store = next(root.glob("*.zarr"))
    metadata = store_metadata(store)
    edge = metadata["poses/default/dynamic_poses/.zattrs"]["('rig', 'world')"]
    for key in ("poses", "timestamps_us"):
        edge[key] = edge[key][:-15]
    write_metadata(store / METADATA, metadata)
    scene = extract_scene(source(), root, None, tmp_path / "out")
    assert len(scene.sweeps) == 3 and len(scene.frames) < len(whole.frames)
    assert max(frame.timestamp for frame in scene.frames) <= recording.times[-16]
    assert len(outline(root, "", NAME).key_frames) == 3


# Lenses

SIZE = (320, 240)
K = np.array([[180.0, 0.0, 161.0], [0.0, 182.0, 118.0], [0.0, 0.0, 1.0]])


def ftheta(reference: str, cde: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> Any:
    from ncore.data import FThetaCameraModelParameters, ShutterType

    forward = np.array([0.0, 170.0, 2.0, -6.0, 0.5, -0.1], dtype=np.float32)
    angles = np.linspace(0.0, 1.5, 400)
    radii = np.polynomial.polynomial.polyval(angles, forward)
    backward = np.linalg.lstsq(radii[:, None] ** np.arange(1, 6), angles, rcond=None)[0]
    return FThetaCameraModelParameters(
        resolution=np.array(SIZE, dtype=np.uint64), shutter_type=ShutterType.ROLLING_LEFT_TO_RIGHT,
        external_distortion_parameters=None, principal_point=np.array([160.5, 119.0], dtype=np.float32),
        reference_poly=FThetaCameraModelParameters.PolynomialType[reference],
        pixeldist_to_angle_poly=np.array([0.0, *backward], dtype=np.float32), angle_to_pixeldist_poly=forward,
        max_angle=1.5, linear_cde=np.array(cde, dtype=np.float32),
    )  # fmt: skip


def fisheye() -> Any:
    from ncore.data import OpenCVFisheyeCameraModelParameters, ShutterType

    return OpenCVFisheyeCameraModelParameters(
        resolution=np.array(SIZE, dtype=np.uint64), shutter_type=ShutterType.ROLLING_BOTTOM_TO_TOP,
        external_distortion_parameters=None, principal_point=np.array([161.5, 118.5], dtype=np.float32),
        focal_length=np.array([150.0, 151.0], dtype=np.float32),
        radial_coeffs=np.array([0.02, -0.004, 0.001, -0.0002], dtype=np.float32), max_angle=1.5,
    )  # fmt: skip


def ideal() -> Any:
    from ncore.data import IdealPinholeCameraModelParameters, ShutterType

    return IdealPinholeCameraModelParameters(
        resolution=np.array(SIZE, dtype=np.uint64), shutter_type=ShutterType.GLOBAL,
        external_distortion_parameters=None, principal_point=np.array([160.0, 120.0], dtype=np.float32),
        focal_length=np.array([200.0, 201.0], dtype=np.float32),
    )  # fmt: skip


LENSES = {
    "ideal": (ideal, "none", None),
    "pinhole": (lambda: pinhole(K, SIZE), "none", "down"),
    "distorted": (
        lambda: pinhole(
            K, SIZE, "ROLLING_RIGHT_TO_LEFT", radial_coeffs=[-0.12, 0.02, 0.001, 0.01, 0.002, 0.0003],
            tangential_coeffs=[0.001, -0.002], thin_prism_coeffs=[0.0005, -0.0003, 0.0002, 0.0001],
        ),
        "opencv", "left",
    ),
    "fisheye": (fisheye, "fisheye", "up"),
    "forward f-theta": (lambda: ftheta("ANGLE_TO_PIXELDIST"), "angle_to_radius", "right"),
    "backward f-theta": (lambda: ftheta("PIXELDIST_TO_ANGLE"), "radius_to_angle", "right"),
    "sheared f-theta": (lambda: ftheta("ANGLE_TO_PIXELDIST", (1.02, 0.01, -0.015)), "angle_to_radius", "right"),
    "sheared backward": (lambda: ftheta("PIXELDIST_TO_ANGLE", (0.97, -0.02, 0.01)), "radius_to_angle", "right"),
}  # fmt: skip


@pytest.mark.parametrize("name", LENSES)
def test_lenses_image_directions_where_ncores_models_do(name):
    """Within a hundredth of a pixel, of pixels whose first has its centre at 0.5 in NCore."""
    import torch
    from ncore.sensors import camera_model_from_parameters

    make, model, direction = LENSES[name]
    parameters = make()
    camera = camera_of("side", parameters, 0.02)
    assert (camera.distortion_model, camera.readout_direction) == (model, direction)
    assert camera.readout_s == (0.0 if direction is None else 0.02) and (camera.width, camera.height) == SIZE
    reach = 1.2 if "f-theta" in name or name in ("fisheye", "sheared backward") else 0.6
    angle, around = np.meshgrid(np.linspace(0.01, reach, 12), np.linspace(0, 2 * np.pi, 24, endpoint=False))
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=-1)
    found = camera_model_from_parameters(parameters, device="cpu", dtype=torch.float64).camera_rays_to_image_points(
        rays.reshape(-1, 3)
    )
    seen = found.valid_flag.numpy()
    assert seen.sum() > 100
    mine = pixels_of(camera, rays.reshape(-1, 3))[seen]
    np.testing.assert_allclose(mine, found.image_points.numpy()[seen] - 0.5, atol=0.01)


@pytest.mark.parametrize("name", ["distorted", "fisheye", "sheared f-theta", "backward f-theta"])
def test_images_of_lenses_are_resampled(name, turning, tmp_path):
    from io import BytesIO

    from PIL import Image

    _, recording, _, _ = turning
    png = BytesIO()
    Image.new("RGB", SIZE, (10, 200, 30)).save(png, "PNG")
    mount, _, images = recording.cameras["front"]
    frames = [(start, end, png.getvalue(), "png") for start, end, _, _ in images[:2]]
    alone = Recording(recording.times, recording.rig_to_global, {"side": (mount, LENSES[name][0](), frames)})
    scene = extract_scene(source(cameras=("side",)), write_clip(tmp_path / "clip", alone), None, tmp_path / "out")
    (camera,) = scene.cameras
    assert camera.distortion_model == "none" and len(scene.frames) == 2
    assert not camera.intrinsics[0, 1] and not camera.intrinsics[1, 0]
    for frame in scene.frames:
        assert "undistorted" in frame.image_path and frame.camera_velocity is not None
        with Image.open(frame.image_path) as image:
            assert image.size == SIZE and image.getpixel((0, 0)) == (10, 200, 30)


def test_a_windshield_is_named(caplog):
    from ncore.data import BivariateWindshieldModelParameters, ReferencePolynomial

    parameters, values = ideal(), np.array([0.0, 1.0, 0.0], dtype=np.float32)
    parameters.external_distortion_parameters = BivariateWindshieldModelParameters(
        ReferencePolynomial.FORWARD, values, values, values, values
    )
    with caplog.at_level(logging.WARNING):
        camera_of("wide", parameters, None)
    assert "camera wide: its images were taken through a windshield" in caplog.text


def test_a_global_shutter_has_the_pose_of_the_start(turning, tmp_path):
    world, recording, _, _ = turning
    mount, _, images = recording.cameras["front"]
    still = pinhole(world.intrinsics, (world.width, world.height), "GLOBAL")
    alone = Recording(recording.times, recording.rig_to_global, {"front": (mount, still, images)})
    scene = extract_scene(source(), write_clip(tmp_path / "clip", alone), None, tmp_path / "out")
    for frame, (start, _, _, _) in zip(scene.frames, images, strict=True):
        assert frame.camera_velocity is None and frame.timestamp == start
        expected = moved(world.ego(start) @ mount, -scene.origin)
        np.testing.assert_allclose(frame.camera_to_world, expected, atol=1e-6)
    assert scene.cameras[0].readout_s == 0.0 and not scene.sweeps


# Classes


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("automobile", ObjectClass.CAR), ("Heavy_truck", ObjectClass.TRUCK), ("train_or_tram_car", ObjectClass.TRAM),
        ("person", ObjectClass.PEDESTRIAN), ("rider", ObjectClass.RIDER), ("stroller", ObjectClass.OTHER_MOVABLE),
        ("TYPE_VEHICLE", ObjectClass.VEHICLE), ("TYPE_CYCLIST", ObjectClass.RIDER), ("Van", ObjectClass.CAR),
        ("vehicle.bus.rigid", ObjectClass.BUS), ("human.pedestrian.adult", ObjectClass.PEDESTRIAN),
        ("movable_object.trafficcone", ObjectClass.OTHER_MOVABLE), ("REGULAR_VEHICLE", ObjectClass.CAR),
        ("vehicle.construction", ObjectClass.CONSTRUCTION_VEHICLE), ("zeppelin", None), ("", None),
    ],
)  # fmt: skip
def test_labels_of_datasets_are_known(label, expected):
    assert object_class(label) is expected


def test_observations_are_merged_by_track(turning, tmp_path, caplog):
    """Observations of one track in two frames of reference; manual labels count before automatic ones at one time, and
    an unknown label is named."""
    world, recording, _, _ = turning
    thing, sweeps = world.things[0], recording.lidars["lidar"][2]
    boxes = []
    for number, rays in enumerate(sweeps):
        time = (rays.start + rays.end) // 2
        label, in_world = "zeppelin", inverse(world.ego(START_US)) @ world.box(thing, time)
        wrong = moved(in_world, np.array([5.0, 0.0, 0.0]))
        boxes.append(("one", label, time, "world", rays.end, wrong, thing.size, "AUTOLABEL"))
        frame, base = ("rig", np.eye(4)) if number % 2 else ("lidar", LIDAR)
        at = int(recording.times[10 * number])
        box = inverse(world.ego(at) @ base) @ world.box(thing, time)
        boxes.append(("one", label, time, frame, at, box, thing.size, "GT_ANNOTATION"))
    changed = Recording(recording.times, recording.rig_to_global, recording.cameras, recording.lidars, boxes)
    with caplog.at_level(logging.WARNING):
        scene = extract_scene(source(), write_clip(tmp_path / "clip", changed), None, tmp_path / "out")
    (track,) = scene.tracks
    assert track.object_class is ObjectClass.OTHER_MOVABLE and "zeppelin (1)" in caplog.text
    for time, pose in zip(track.timestamps.tolist(), track.object_to_world, strict=True):
        np.testing.assert_allclose(pose, moved(world.box(thing, time), -scene.origin), atol=1e-6)


def test_the_manifest_lists_the_stores(turning, tmp_path):
    root = write_clip(tmp_path, turning[1], separate=True)
    stores = {entry["path"] for entry in json.loads((root / f"{NAME}.json").read_text())["component_stores"]}
    assert {file.name for file in table_files(root, "", NAME)} == {f"{NAME}.json", *stores} and len(stores) == 3
