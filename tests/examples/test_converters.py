"""The worked converters: each test writes a small drive in a dataset's own layout, by the formulas of that dataset's
documentation, and compares what the converter makes of it with the world that it shows."""

import io
import lzma
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
import pyarrow
import pytest
from helpers import REPOSITORY
from helpers.drives import TILTED_CAMERA, TIMES, World, rays_at, seconds_of, seen_from, turning_world
from helpers.mutations import damages, fresh, mutate_file
from helpers.shown_drives import assert_shows, origin_of, require_refused_or_sound, world_points
from helpers.table_files import time_limit
from PIL import Image
from pyarrow import feather
from scipy.spatial.transform import Rotation

from drivesplat.lidar.scans import scan_of, sensor_poses
from drivesplat.readers.drive.check import check, whole_scene
from drivesplat.readers.drive.format import read_drive
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.rigid import apply, inverse, rigid
from drivesplat.scene.scene import Scene
from examples import argoverse2, kitti_raw, kitti_scans, pandaset

TILT = Rotation.from_euler("ZYX", [0.65, 0.05, -0.03]).as_matrix()
ELEVATIONS = np.radians(np.linspace(-25.0, 3.0, 8))
AZIMUTHS = np.radians(np.arange(179.0, -180.0, -6.0))
"""Of a scan, in the order in which it turns clockwise from behind the vehicle."""
RINGS = np.radians(np.linspace(-2.0, -24.0, 64))
"""Elevations of KITTI's scanner."""


# KITTI raw

DELAY, SPIN = 4_000, 50_000
"""Microseconds between a key frame and what the GPS/IMU unit says; half a turn of the scanner."""
LATITUDE, LONGITUDE, RADIUS = 49.01, 8.43, 6378137.0
IMU = rigid(np.eye(3), np.array([0.0, 0.0, 0.93]))
VELODYNE = rigid(Rotation.from_euler("z", 0.02).as_matrix(), np.array([0.81, -0.32, 1.73]))
"""Mounts in the ego frame. Tracklets have a heading only: the scanner is level."""
KITTI_NAMES = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian"}


def lines_of(times: np.ndarray) -> str:
    """Times in KITTI's form, to the nanosecond."""
    return "".join(str(np.datetime64(int(t) * 1000, "ns")).replace("T", " ") + "\n" for t in times)


def oxts(pose: np.ndarray) -> str:
    """The record of the GPS/IMU unit at a pose (x east, y north, z up, near LATITUDE and LONGITUDE), on a spherical
    earth. Angles as KITTI's dataformat.txt says: roll is positive with the left side up, pitch with the front down,
    yaw is 0 towards the east and positive counter-clockwise."""
    (east, north, up), (forward, left, upward) = pose[:3, 3], pose[:3, :3].T
    latitude = LATITUDE + np.degrees(north / RADIUS)
    longitude = LONGITUDE + np.degrees(east / (RADIUS * np.cos(np.radians(LATITUDE))))
    roll = np.arctan2(left[2], upward[2])
    pitch, yaw = -np.arcsin(forward[2]), np.arctan2(forward[1], forward[0])
    return " ".join(f"{v:.15g}" for v in (latitude, longitude, up, roll, pitch, yaw, *np.zeros(19), 4, 8, 4, 4, 0))


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.12e}" for value in np.ravel(values))


def write_calibration(day: Path, drive: World) -> dict[str, np.ndarray]:
    """The three files, such that camera 2 is mounted as TILTED_CAMERA; returns the matrices of KITTI's readme."""
    K = drive.intrinsics
    shift = np.array([0.06, -0.001, 0.003])
    rectifying = Rotation.from_euler("xyz", [0.01, -0.015, 0.02]).as_matrix()
    rectified_to_ego = TILTED_CAMERA @ rigid(np.eye(3), shift)
    velo_to_cam = rigid(rectifying.T, np.zeros(3)) @ inverse(rectified_to_ego) @ VELODYNE
    imu_to_velo = inverse(VELODYNE) @ IMU
    projection = K @ np.column_stack([np.eye(3), shift])
    (day / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
        f"S_rect_02: {numbers([drive.width, drive.height])}\n"
        f"R_rect_00: {numbers(rectifying)}\nP_rect_02: {numbers(projection)}\n"
    )
    for name, matrix in (("velo_to_cam", velo_to_cam), ("imu_to_velo", imu_to_velo)):
        text = f"calib_time: 15-Mar-2012 11:37:16\nR: {numbers(matrix[:3, :3])}\nT: {numbers(matrix[:3, 3])}\n"
        (day / f"calib_{name}.txt").write_text(text)
    return {"P": projection, "R": rigid(rectifying, np.zeros(3)), "velo_to_cam": velo_to_cam}


def tracklets_xml(drive: World) -> str:
    """Boxes as boost serializes them: relative to the scanner, standing on their bottom, with a heading."""
    items = []
    for thing in drive.things:
        poses = []
        for time in TIMES:
            box = inverse(drive.ego(time) @ VELODYNE) @ drive.box(thing, time)
            x, y, z = box[:3, 3] - [0.0, 0.0, thing.size[2] / 2]
            heading = np.arctan2(box[1, 0], box[0, 0])
            poses.append(
                f"<item><tx>{x:.9g}</tx><ty>{y:.9g}</ty><tz>{z:.9g}</tz><rx>0</rx><ry>0</ry><rz>{heading:.9g}</rz>"
                "<state>2</state><occlusion>1</occlusion><occlusion_kf>0</occlusion_kf><truncation>0</truncation></item>"
            )
        length, width, height = thing.size
        items.append(
            f"<item><objectType>{KITTI_NAMES[thing.category]}</objectType><h>{height}</h><w>{width}</w><l>{length}</l>"
            f"<first_frame>0</first_frame><poses><count>{len(poses)}</count>{''.join(poses)}</poses></item>"
        )
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?><!DOCTYPE boost_serialization>'
        '<boost_serialization signature="serialization::archive" version="9"><tracklets class_id="0">'
        f"<count>{len(items)}</count><item_version>1</item_version>{''.join(items)}</tracklets></boost_serialization>"
    )


def scan(drive: World, time: int) -> tuple[np.ndarray, np.ndarray]:
    """A turn of the scanner that looks forward at `time`, clockwise from behind: what it writes, each point as seen at
    its own time, and where the points are in the world; (n, 3) each. Points come ring by ring, each by its azimuth from
    0 to 360 degrees."""
    raw, true = [], []
    for azimuth in AZIMUTHS:
        now = time - SPIN * azimuth / np.pi
        hits = drive.hits(VELODYNE, rays_at(azimuth, RINGS), now)
        true.append(hits)
        raw.append(seen_from(drive.ego(now) @ VELODYNE, hits))
    points, hits = np.concatenate(raw), np.concatenate(true)
    order = np.lexsort([np.mod(azimuths_of(points), 2 * np.pi), rings_of(points)])
    return points[order], hits[order]


def azimuths_of(points: np.ndarray) -> np.ndarray:
    return np.arctan2(points[:, 1], points[:, 0])


def rings_of(points: np.ndarray) -> np.ndarray:
    """The rings (n,) of a scan's points, which are exact."""
    elevations = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    return np.abs(elevations[:, None] - RINGS).argmin(axis=1)


LOST = 4


@pytest.fixture(scope="module")
def kitti(tmp_path_factory) -> tuple[Path, World, dict[str, np.ndarray]]:
    """A day of KITTI raw with the drive 0005, of which one scan is lost, with an empty line as its time."""
    day = tmp_path_factory.mktemp("kitti") / "2011_09_26"
    drive = turning_world(rigid(TILT, np.array([3.0, -7.0, 120.0])))
    folder = day / "2011_09_26_drive_0005_sync"
    for name in ("image_02/data", "oxts/data", "velodyne_points/data"):
        (folder / name).mkdir(parents=True)
    matrices = write_calibration(day, drive)
    velodyne = folder / "velodyne_points"
    for name, offset in (("_start", -SPIN), ("", 0), ("_end", SPIN)):
        lines = lines_of(TIMES + offset).splitlines()
        lines[LOST] = ""
        (velodyne / f"timestamps{name}.txt").write_text("\n".join(lines) + "\n")
    (folder / "image_02/timestamps.txt").write_text(lines_of(TIMES - 1_000))
    (folder / "oxts/timestamps.txt").write_text(lines_of(TIMES + DELAY))
    (folder / "tracklet_labels.xml").write_text(tracklets_xml(drive))
    for i, time in enumerate(TIMES):
        Image.fromarray(drive.image(seconds_of(time - 1_000), TILTED_CAMERA)).save(
            folder / f"image_02/data/{i:010}.png"
        )
        (folder / f"oxts/data/{i:010}.txt").write_text(oxts(drive.ego(time + DELAY) @ IMU) + "\n")
        points, _ = scan(drive, int(time))
        if i != LOST:
            reflectance = np.full((len(points), 1), 0.25)
            np.hstack([points, reflectance]).astype(np.float32).tofile(velodyne / f"data/{i:010}.bin")
    return day, drive, matrices


@pytest.fixture(scope="module")
def kitti_scene(kitti, tmp_path_factory) -> Scene:
    out = tmp_path_factory.mktemp("drives") / "kitti"
    assert kitti_raw.main([str(kitti[0]), "5", str(out)]) == 0
    assert check(out, None) == []
    return whole_scene(read_drive(out), out)


def test_kitti_raw_shows_the_world_that_it_recorded(kitti, kitti_scene):
    _, drive, matrices = kitti
    assert_shows(kitti_scene, drive, -1_000, {"velodyne": VELODYNE}, atol=5e-3)
    assert [sweep.timestamp for sweep in kitti_scene.sweeps] == np.delete(TIMES, 4).tolist()
    assert [track.category for track in kitti_scene.tracks] == ["Car", "Truck", "Pedestrian"]
    assert [track.object_class for track in kitti_scene.tracks] == ["car", "truck", "pedestrian"]
    assert all(set(track.visibility) == {2} for track in kitti_scene.tracks), "partly occluded"
    # KITTI's readme: Y = P_rect_02 · R_rect_00 · (R|T)_velo_to_cam · X, here as the scanner sees X at the image's time.
    frame, point = kitti_scene.frames[3], np.array([12.0, 1.5, -0.4, 1.0])
    x, y, z = matrices["P"] @ matrices["R"] @ matrices["velo_to_cam"] @ point
    in_world = (drive.ego(frame.timestamp) @ VELODYNE @ point)[:3] - origin_of(kitti_scene, drive)
    found = frame.intrinsics @ seen_from(frame.camera_to_world, in_world[None])[0]
    np.testing.assert_allclose(found[:2] / found[2], [x / z, y / z], atol=0.05)


def test_scans_of_kitti_raw_are_untwisted_and_have_rings_times_and_elevations(kitti, kitti_scene):
    _, drive, _ = kitti
    sweep, (points, true) = kitti_scene.sweeps[2], scan(drive, int(TIMES[2]))
    np.testing.assert_allclose(world_points(kitti_scene, 2, drive), true, atol=5e-3)
    twisted = apply(drive.ego(TIMES[2]) @ VELODYNE, points)
    assert np.linalg.norm(twisted - true, axis=1).max() > 0.5, "the test would not see a difference"
    returns = read_returns(sweep)
    assert (returns.intensity == 0.25).all()
    np.testing.assert_allclose(kitti_scene.lidars[0].beam_elevations, RINGS, atol=1e-6)
    np.testing.assert_array_equal(returns.rings, rings_of(points))
    np.testing.assert_allclose(returns.offsets_s, -SPIN * 1e-6 * azimuths_of(points) / np.pi, atol=1e-7)
    rays = scan_of(returns, kitti_scene.lidars[0], sensor_poses(sweep, kitti_scene.sweeps))
    assert rays.ranges.shape == (64, len(AZIMUTHS)) and (rays.ranges > 0).sum() == len(points)
    np.testing.assert_allclose(np.median(rays.rays.elevations, axis=1), RINGS, atol=2e-3)


def test_scans_of_another_order_are_converted_with_a_warning(kitti, tmp_path, capsys):
    """One scan ends after 40 rings, one has a stray return, one is shuffled."""
    day, drive, _ = kitti
    copied = Path(shutil.copytree(day, tmp_path / day.name))
    files = [copied / f"2011_09_26_drive_0005_sync/velodyne_points/data/{i:010}.bin" for i in (0, 1, 2)]
    cut, stray, shuffled = (np.fromfile(file, dtype=np.float32).reshape(-1, 4) for file in files)
    rings = rings_of(scan(drive, int(TIMES[0]))[0])
    cut[rings < 40].tofile(files[0])
    np.vstack([stray, stray[:1]]).tofile(files[1])
    np.random.default_rng(0).permutation(shuffled).tofile(files[2])
    assert kitti_raw.main([str(copied), "5", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert "2 of 5 scans (first: 0000000000.bin) have another number of rings than 64" in said
    assert "1 of 5 scans (first: 0000000002.bin) have returns in another order" in said and said.count("\n") == 2
    first, second, third = (np.load(tmp_path / f"out/velodyne/{i:010}.npz") for i in (0, 1, 2))
    np.testing.assert_array_equal(first["ring"], rings[rings < 40])
    assert second["ring"][-1] == 0 and set(second["ring"]) == set(range(64))
    assert "ring" not in third and "time" in third


def test_rings_of_recorded_scans_are_those_of_their_elevations():
    """KITTI's own scans: each ring has nearly one elevation, and rings go down from +2.9 to -23.6 degrees."""
    path = REPOSITORY / "../shared/data/kitti-lidar-22-scans/scans.npz.xz"
    if not path.is_file():
        pytest.skip(f"the recorded scans are not in {path}")
    recorded = np.load(io.BytesIO(lzma.decompress(path.read_bytes())))
    points, rings = recorded["xyz_11"].T * 0.005, recorded["ring_11"]
    laps = kitti_scans.laps_of(points)
    assert laps[-1] == 63 and (laps == rings).mean() > 0.999
    beams = kitti_scans.medians(kitti_scans.elevations_of(points), laps)
    assert (np.diff(beams) < 0).all() and -0.43 < beams[-1] < -0.40 and 0.03 < beams[0] < 0.06
    np.testing.assert_array_equal(kitti_scans.rings_of(points, beams), laps)
    without_one = points[laps != 17]
    np.testing.assert_array_equal(kitti_scans.rings_of(without_one, beams), laps[laps != 17])


def test_scans_that_are_compensated_already_are_left_as_they_are(kitti, tmp_path):
    day, drive, _ = kitti
    points, _ = scan(drive, int(TIMES[2]))
    assert kitti_raw.main([str(day), "0005", str(tmp_path / "c"), "--cameras", "02", "--scans", "compensated"]) == 0
    scene = whole_scene(read_drive(tmp_path / "c"), tmp_path / "c")
    np.testing.assert_allclose(read_returns(scene.sweeps[2]).points, points, atol=1e-5)
    mirrored = points * [1.0, -1.0, 1.0]
    start, end = drive.ego(TIMES[2] - SPIN) @ VELODYNE, drive.ego(TIMES[2] + SPIN) @ VELODYNE
    directions = ("clockwise", "counter-clockwise")
    turned, other = (kitti_raw.untwisted(mirrored, scans, start, end, start) for scans in directions)
    assert np.linalg.norm(turned - other, axis=1).max() > 0.3


# Argoverse 2

EGO_HEIGHT = rigid(np.eye(3), np.array([0.0, 0.0, 0.33]))
"""The origin of Argoverse's ego frame is above the ground."""
AV2_LIDARS = {
    "up_lidar": rigid(np.eye(3), np.array([1.35, 0.0, 1.97])),
    "down_lidar": rigid(Rotation.from_euler("zx", [0.2, np.pi]).as_matrix(), np.array([1.355, 0.0, 1.9])),
}
AV2_DELAY = 17_000
AV2_NAMES = {"car": "REGULAR_VEHICLE", "truck": "BOX_TRUCK", "pedestrian": "PEDESTRIAN"}


def se3_columns(poses: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Poses as Argoverse's tables have them."""
    rotations = Rotation.from_matrix([pose[:3, :3] for pose in poses]).as_quat()
    columns = dict(zip(("qx", "qy", "qz", "qw"), rotations.T, strict=True))
    return columns | dict(zip(("tx_m", "ty_m", "tz_m"), np.array([pose[:3, 3] for pose in poses]).T, strict=True))


def av2_hits(drive: World, name: str, time: float) -> np.ndarray:
    rays = np.concatenate([rays_at(azimuth, ELEVATIONS) for azimuth in AZIMUTHS])
    return drive.hits(AV2_LIDARS[name], rays, time)


@pytest.fixture(scope="module")
def argoverse(tmp_path_factory) -> tuple[Path, World]:
    """A log of Argoverse 2; returns of both LiDARs are in one table, in the ego frame of the sweep's time."""
    log = tmp_path_factory.mktemp("av2") / "01bb304d-7bd8-35f8-bbef-7086b688e35e"
    drive = turning_world(rigid(TILT, np.array([747.4, 1275.3, -24.3])))

    def vehicle(time: float) -> np.ndarray:
        """city_SE3_egovehicle"""
        return drive.ego(time) @ EGO_HEIGHT

    times = [int(t) * 1000 for t in np.sort(np.concatenate([TIMES, TIMES + AV2_DELAY, TIMES - 5_000]))]
    times = sorted([*times, times[3] + 1])  # two within a nanosecond, as in the documentation
    poses = {"timestamp_ns": np.array(times), **se3_columns([vehicle(t / 1000) for t in times])}
    write_table(log / "city_SE3_egovehicle.feather", poses)
    mounts = {"ring_front_center": TILTED_CAMERA, **AV2_LIDARS}
    sensors = se3_columns([inverse(EGO_HEIGHT) @ mount for mount in mounts.values()])
    write_table(log / "calibration/egovehicle_SE3_sensor.feather", {"sensor_name": list(mounts), **sensors})
    K, columns = drive.intrinsics, {"fx_px": (0, 0), "fy_px": (1, 1), "cx_px": (0, 2), "cy_px": (1, 2)}
    intrinsics = {
        "sensor_name": ["ring_front_center", "ring_rear_left"],
        **{name: [K[at], 50.0] for name, at in columns.items()},
        "k1": [-0.27, -0.2], "k2": [-0.21, -0.1], "k3": [0.33, 0.2],
        "height_px": [drive.height, 60], "width_px": [drive.width, 80],
    }  # fmt: skip
    write_table(log / "calibration/intrinsics.feather", intrinsics)
    (log / "sensors/cameras/ring_front_center").mkdir(parents=True)
    for time in TIMES:
        image = Image.fromarray(drive.image(seconds_of(time + AV2_DELAY), TILTED_CAMERA))
        image.save(log / f"sensors/cameras/ring_front_center/{(time + AV2_DELAY) * 1000}.jpg", quality=97)
        write_table(log / f"sensors/lidar/{time * 1000}.feather", sweep_table(drive, vehicle(time), time))
    rows = [(time, thing) for time in TIMES for thing in drive.things]
    boxes = [inverse(vehicle(time)) @ drive.box(thing, time) for time, thing in rows]
    annotations = {
        "timestamp_ns": [int(time) * 1000 for time, _ in rows],
        "track_uuid": [f"uuid {thing.category}" for _, thing in rows],
        "category": [AV2_NAMES[thing.category] for _, thing in rows],
        **{f"{name}_m": [thing.size[i] for _, thing in rows] for i, name in enumerate(("length", "width", "height"))},
        **se3_columns(boxes), "num_interior_pts": [7] * len(rows),
    }  # fmt: skip
    write_table(log / "annotations.feather", annotations)
    return log, drive


def sweep_table(drive: World, vehicle: np.ndarray, time: float) -> dict[str, np.ndarray]:
    """Returns of both LiDARs, mixed: lasers 0 to 31 are those of the upper one."""
    parts = []
    for first, name in ((0, "up_lidar"), (32, "down_lidar")):
        points = seen_from(vehicle, av2_hits(drive, name, time))
        parts.append(np.column_stack([points, first + np.arange(len(points)) % 32]))
    rows = np.random.default_rng(0).permutation(np.concatenate(parts))
    return {
        **dict(zip("xyz", rows[:, :3].T.astype(np.float32), strict=True)),
        "intensity": np.full(len(rows), 51, dtype=np.uint8),
        "laser_number": rows[:, 3].astype(np.uint8),
        "offset_ns": np.full(len(rows), 3_318_000, dtype=np.int32),
    }


def write_table(path: Path, columns: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pyarrow.table(columns), path)


@pytest.fixture(scope="module")
def argoverse_scene(argoverse, tmp_path_factory) -> Scene:
    out = tmp_path_factory.mktemp("drives") / "argoverse"
    assert argoverse2.main([str(argoverse[0]), str(out)]) == 0
    assert check(out, None) == []
    return whole_scene(read_drive(out), out)


def test_argoverse2_shows_the_world_that_it_recorded(argoverse, argoverse_scene):
    _, drive = argoverse
    assert argoverse_scene.key_frame_timestamps.tolist() == TIMES.tolist()
    assert_shows(argoverse_scene, drive, AV2_DELAY, AV2_LIDARS, atol=2e-3)
    assert [track.category for track in argoverse_scene.tracks] == list(AV2_NAMES.values())
    assert [track.object_class for track in argoverse_scene.tracks] == ["car", "truck", "pedestrian"]


def test_returns_of_argoverse2_belong_to_the_lidar_that_recorded_them(argoverse, argoverse_scene):
    _, drive = argoverse
    assert [sweep.lidar for sweep in argoverse_scene.sweeps] == ["up_lidar"] * 6 + ["down_lidar"] * 6
    for number, name in ((2, "up_lidar"), (8, "down_lidar")):
        found, true = world_points(argoverse_scene, number, drive), av2_hits(drive, name, TIMES[2])
        nearest = np.linalg.norm(found[:, None] - true[None], axis=2).min(axis=1)
        assert len(found) == len(true) > 100 and nearest.max() < 2e-3
        returns = read_returns(argoverse_scene.sweeps[number])
        elevations = np.arcsin(returns.points[:, 2] / np.linalg.norm(returns.points, axis=1))
        assert np.abs(elevations[:, None] - ELEVATIONS).min(axis=1).max() < 1e-3, "in the LiDAR's own frame"
        np.testing.assert_allclose(returns.intensity, 0.2, atol=1e-6)
        np.testing.assert_allclose(returns.offsets_s, 0.003318)
        assert set(returns.rings) == set(range(32))


def test_a_log_of_argoverse2_without_images_is_a_drive_of_lidar(argoverse, tmp_path, capsys):
    log, drive = Path(shutil.copytree(argoverse[0], tmp_path / "log")), argoverse[1]
    shutil.rmtree(log / "sensors/cameras")
    (log / "calibration/intrinsics.feather").unlink()
    assert argoverse2.main([str(log), str(tmp_path / "out")]) == 0
    assert "no images of ring cameras: the drive is one of LiDAR alone" in capsys.readouterr().err
    assert check(tmp_path / "out", None) == []
    scene = whole_scene(read_drive(tmp_path / "out"), tmp_path / "out")
    assert not scene.frames and len(scene.sweeps) == 12 and len(scene.tracks) == 3
    assert scene.key_frame_timestamps.tolist() == TIMES.tolist()
    begin, end = ((drive.ego(TIMES[i]) @ AV2_LIDARS["up_lidar"])[:3, 3] for i in (0, 3))
    moved = scene.sweeps[3].sensor_to_world[:3, 3] - scene.sweeps[0].sensor_to_world[:3, 3]
    np.testing.assert_allclose(moved, end - begin, atol=2e-3)


@pytest.mark.slow
def test_the_recorded_fragment_of_argoverse2_is_converted(tmp_path):
    logs = list((REPOSITORY / "../shared/data/av2-log-fragment").glob("*/calibration"))
    if not logs:
        pytest.skip("the recorded log is not in ../shared/data/av2-log-fragment")
    assert argoverse2.main([str(logs[0].parent), str(tmp_path / "out")]) == 0
    assert check(tmp_path / "out", None) == []
    drive = read_drive(tmp_path / "out")
    assert (len(drive.key_frames or ()), len(drive.sweeps), len(drive.tracks)) == (2, 4, 114)


# All converters


IMAGES, SCANS, OXTS = "{drive}/image_02", "{drive}/velodyne_points", "{drive}/oxts"


def replaced(old: str, new: str) -> Callable[[Path], object]:
    """A change of a text file: the first `old` becomes `new`."""
    return lambda path: path.write_text(path.read_text().replace(old, new, 1))


def without_the_last_line(path: Path) -> None:
    path.write_text(path.read_text().rstrip("\n").rpartition("\n")[0])


def a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("path", "change", "words"),
    [
        ("calib_velo_to_cam.txt", Path.unlink, "calib_velo_to_cam.txt is missing"),
        ("calib_velo_to_cam.txt", replaced("T:", "U:"), "calib_velo_to_cam.txt has no line that begins with T:"),
        ("calib_imu_to_velo.txt", replaced("R: ", "R: 7"), "calib_imu_to_velo.txt: its transform is not rigid"),
        (f"{IMAGES}/timestamps.txt", lambda p: p.write_text("yesterday\n"), "timestamps.txt cannot be read: line 1 is"),
        (f"{SCANS}/timestamps_start.txt", without_the_last_line, "timestamps_start.txt: line 6 has no time, and there"),
        (f"{SCANS}/timestamps_end.txt", replaced("2018", "2019"), "line 1: the scan begins 0.05 s before"),
        (f"{OXTS}/timestamps.txt", replaced("2018", "2019"), "timestamps.txt: line 2 is not later than"),
        (f"{OXTS}/data/0000000003.txt", replaced("49.", "149."), "no latitude and longitude"),
        ("{drive}/tracklet_labels.xml", replaced("Car", "Cart"), "tracklet 0: its objectType is 'Cart'"),
        (f"{SCANS}/data/0000000000.bin", lambda p: p.write_bytes(b"\xff" * 160), "10 of its 10 returns have values"),
        (f"{SCANS}/data/0000000001.bin", a_pipe, "0000000001.bin is not a file"),
        ("{drive}", lambda p: p.rename(p.with_name("x")), "there is no folder"),
    ],
)
def test_a_damaged_day_of_kitti_ends_with_a_sentence(path, change: Callable, words, kitti, tmp_path, capsys):
    day = Path(shutil.copytree(kitti[0], tmp_path / "2011_09_26"))
    change(day / path.format(drive="2011_09_26_drive_0005_sync"))
    with time_limit():
        assert kitti_raw.main([str(day), "0005", str(tmp_path / "out"), "--cameras", "02"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("kitti_raw: ") and said.count("\n") == 1 and words in said


def test_a_damaged_log_of_argoverse2_ends_with_a_sentence(argoverse, tmp_path, capsys):
    assert argoverse2.main([str(tmp_path), str(tmp_path / "out")]) == 1
    assert "egovehicle_SE3_sensor.feather is missing" in capsys.readouterr().err
    assert argoverse2.main([str(argoverse[0]), str(tmp_path / "out"), "--cameras", "ring_rear_left"]) == 1
    assert "no images or no intrinsics of ring_rear_left" in capsys.readouterr().err
    (tmp_path / "calibration").mkdir()
    (tmp_path / "calibration/egovehicle_SE3_sensor.feather").write_bytes(b"no table")
    assert argoverse2.main([str(tmp_path), str(tmp_path / "out")]) == 1
    assert "egovehicle_SE3_sensor.feather cannot be read" in capsys.readouterr().err


def damaged(random: Random, folder: Path) -> str:
    """Damages a file of a recording; each kind of file is as likely as another."""
    kinds: dict[tuple[str, str], list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            kinds.setdefault((path.parent.name, path.suffix), []).append(path)
    return mutate_file(random, random.choice(kinds[random.choice(list(kinds))]))


@damages(15, 200)
def test_damaged_days_of_kitti_are_refused_in_one_line_or_sound(kitti, tmp_path, capsys, random):
    with fresh(tmp_path) as folder:
        day, out = folder / "2011_09_26", folder / "out"
        shutil.copytree(kitti[0], day, ignore=shutil.ignore_patterns("*[2-5].png", "*[2-5].bin"))
        done = damaged(random, day)
        require_refused_or_sound(lambda: kitti_raw.main([str(day), "5", str(out)]), out, capsys, done)


@damages(15, 200)
def test_damaged_logs_of_argoverse2_are_refused_in_one_line_or_sound(argoverse, tmp_path, capsys, random):
    with fresh(tmp_path) as folder:
        log, out = folder / "log", folder / "out"
        shutil.copytree(argoverse[0], log, ignore=lambda _, names: sorted(n for n in names if n[0].isdigit())[2:])
        done = damaged(random, log)
        require_refused_or_sound(lambda: argoverse2.main([str(log), str(out)]), out, capsys, done)


@pytest.mark.parametrize("converter", [kitti_raw, argoverse2, pandaset])
def test_converters_have_a_command_line(converter, capsys):
    with pytest.raises(SystemExit) as ended:
        converter.main(["--help"])
    said = capsys.readouterr().out
    assert ended.value.code == 0 and "drive folder" in said and "--cameras" in said
