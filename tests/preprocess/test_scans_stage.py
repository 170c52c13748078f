"""The stage `scans`: which sweeps, rays, times and objects, and what becomes of sweeps that give no scan."""

import dataclasses
import logging

import numpy as np
import pytest
from helpers import drives
from helpers.scan_drives import (
    AZIMUTHS,
    BEAMS,
    KEY_FRAME_US,
    LIDAR,
    SPIN,
    STEPS,
    at,
    directions,
    drive_of,
    job,
    room,
    scene_of,
    sweep_of,
    track_of,
    write_returns,
)
from helpers.waymo_drive import NAME, SWEEP_S, tiny_drive
from helpers.waymo_files import write_v2

from drivesplat.errors import ConfigError, DatasetError
from drivesplat.preprocess.extract import extract_scene
from drivesplat.preprocess.scans import firings, scan_records, spin_of
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan_record import NO_OBJECT
from drivesplat.scene.sensors import Lidar, LidarReturns
from drivesplat.settings.config import load

pytestmark = pytest.mark.usefixtures("uncompared")


def test_key_frames_are_resolved_and_all_sweeps_on_request_each_in_its_group(tmp_path):
    times = [(i * KEY_FRAME_US // 2, i % 2 == 0) for i in range(9)]
    sweeps = [sweep_of(write_returns(tmp_path / f"{t}.npz", room()), t, key_frame=key) for t, key in times]
    scene, holdout = scene_of(sweeps), {"every_nth": 4, "offset": 2, "last_block": 0}
    only_key = scan_records(scene, job(holdout=holdout))
    assert [scan.sample_index for scan in only_key.scans] == [0, 1, 2, 3, 4]
    assert [scan.group for scan in only_key.scans] == ["train", "train", "interpolation", "train", "train"]
    shifted = [
        sweep_of(s.path, s.timestamp + (0 if s.is_key_frame else 1000), key_frame=s.is_key_frame) for s in sweeps
    ]
    everything = scan_records(scene_of(shifted), job(holdout=holdout, sweeps=True))
    groups = {scan.timestamp: scan.group for scan in everything.scans}
    assert len(groups) == 9 and [*groups] == sorted(groups)
    assert groups[750_000 + 1000] == "excluded" and groups[1_250_000 + 1000] == "train"
    assert everything.scans[1].seconds == pytest.approx(0.251)


def test_sweeps_between_key_frames_need_to_be_read():
    with pytest.raises(ConfigError, match=r"scans\.sweeps needs lidar_seed\.sweeps: true"):
        load({"scans": {"sweeps": True}})
    assert load({"scans": {"sweeps": True}, "lidar_seed": {"sweeps": True}}).scans.sweeps


def test_a_scan_holds_the_rays_of_the_pattern_with_and_without_a_return(tmp_path):
    """Points that are not finite are holes."""
    ranges, x = room(), (directions() * 12.0)[..., 0]
    ranges[1, 3] = ranges[0, 100] = np.nan
    ranges[2, 50], x[0, 7] = 30.0, np.nan
    sweeps = [sweep_of(write_returns(tmp_path / "0.npz", ranges), 0, (1.0, 2.0, 3.0))]
    (record,) = scan_records(scene_of(sweeps), job()).scans
    np.testing.assert_allclose(record.sensor_to_world, at((1.0, 2.0, 3.0)))
    scan = record.scan
    np.testing.assert_array_equal(scan.returned, np.isfinite(ranges))
    np.testing.assert_allclose(scan.ranges, np.nan_to_num(ranges), rtol=1e-5)
    np.testing.assert_allclose(scan.rays.directions(), directions(), atol=1e-5)
    np.testing.assert_allclose(scan.intensities, 0.5 * np.isfinite(ranges))
    assert record.measured.all() and (record.objects == NO_OBJECT).all() and not scan.rays.offsets_s.any()
    assert not record.linear.any() and not record.angular.any() and record.group == "train"
    write_returns(tmp_path / "0.npz", room(), x=x.ravel())
    (record,) = scan_records(scene_of(sweeps), job()).scans
    assert np.argwhere(~record.scan.returned).tolist() == [[0, 7]]


def swept(folder, ranges: np.ndarray, count: int) -> list:
    """The same sweep at some key frames."""
    path = write_returns(folder / "each.npz", ranges)
    return [sweep_of(path, i * KEY_FRAME_US) for i in range(count)]


def test_each_return_has_the_object_that_it_lay_in_at_its_own_time(tmp_path):
    """A car passes 8 m to the left at 20 m/s. The beams point there a quarter of a revolution before the timestamp,
    when its box is half a metre behind its place at the timestamp."""
    moving = track_of("car", [(-20.0, 8.0, 0.0), (-10.0, 8.0, 0.0), (0.0, 8.0, 0.0), (10.0, 8.0, 0.0)])
    cone = track_of("cone", [(12.0, 0.0, 0.0)] * 4, ObjectClass.OTHER_MOVABLE)
    ranges = room(30.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_car = np.where(np.sin(AZIMUTHS) > 0, 7.5 / np.sin(AZIMUTHS), np.inf)
    ranges[2] = np.minimum(ranges[2], to_car)
    ranges[2, STEPS // 2] = 12.0
    spin = dataclasses.replace(SPIN, start_azimuth=0.0)  # clockwise from ahead: the left comes after 3/4 of 0.1 s
    scene = scene_of(swept(tmp_path, ranges, 4), cone, moving, lidar=dataclasses.replace(LIDAR, spin=spin))
    records = scan_records(scene, job())
    assert records.tracks == ["cone", "car"]
    objects, beam = records.scans[2].objects, records.scans[2].scan.rays
    with np.errstate(divide="ignore"):
        x = 7.5 / np.tan(beam.azimuths[2].astype(float))
    seconds = 2 * 0.5 + beam.offsets_s[2].astype(float)
    passing = (np.sin(beam.azimuths[2]) > 0.3) & (ranges[2] < 29.0)
    expected = passing & (np.abs(x - 20.0 * (seconds - 1.0)) < 2.0)
    at_timestamp = passing & (np.abs(x) < 2.0)
    np.testing.assert_array_equal(objects[2] == 1, expected)
    assert expected.sum() > 10 and (expected != at_timestamp).any()
    assert (objects[[0, 1, 3]] == NO_OBJECT).all(), "above and below it"
    assert (objects[2, ~expected] == NO_OBJECT).all(), "cones are static"


def test_of_two_boxes_around_a_return_the_nearer_one_is_taken(tmp_path):
    far, near = (track_of(name, [(x, 0.0, 0.0)] * 2) for name, x in (("far", 13.0), ("near", 11.0)))
    scans = scan_records(scene_of(swept(tmp_path, room(), 2), far, near), job()).scans
    assert scans[0].objects[2, STEPS // 2] == 1


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("dataset", SPIN),
        (None, None),
        (
            {"revolution_s": 0.2, "start_azimuth_deg": 90.0, "clockwise": False, "timestamp": 0.5},
            dataclasses.replace(SPIN, revolution_s=0.2, start_s=-0.1, start_azimuth=np.pi / 2, clockwise=False),
        ),
    ],
)
def test_times_follow_from_the_dataset_or_from_the_settings(setting, expected, tmp_path):
    lidar = dataclasses.replace(LIDAR, spin=SPIN)
    assert spin_of(lidar, job(spin=setting).scans) == expected
    (record,) = scan_records(drive_of(tmp_path, [room()], lidar=lidar), job(spin=setting)).scans
    grid = np.zeros(STEPS) if expected is None else expected.offsets_s(record.scan.rays.azimuths[0].astype(float))
    off = np.abs(record.scan.rays.offsets_s[0] - grid)
    assert np.minimum(off, 0.1 if expected is None else np.abs(off - expected.revolution_s)).max() < 1e-5


def test_a_moving_sensor_has_its_mean_velocity_and_sees_walls_where_they_are(tmp_path):
    """Returns are compensated; with the times of a spin, the rays start where the sensor was."""
    paths = [write_returns(tmp_path / f"{i}.npz", room()) for i in range(2)]
    sweeps = [sweep_of(path, i * KEY_FRAME_US, (5.0 * i, 0.0, 0.0)) for i, path in enumerate(paths)]
    record = scan_records(scene_of(sweeps, lidar=dataclasses.replace(LIDAR, spin=SPIN)), job()).scans[1]
    np.testing.assert_allclose(record.linear, [10.0, 0.0, 0.0], atol=1e-6)
    scan = record.scan
    starts = np.array([5.0, 0.0, 0.0]) + record.linear * scan.rays.offsets_s[..., None]
    ends = starts + scan.rays.directions() * scan.ranges[..., None]
    away = np.linalg.norm(ends - [5.0, 0.0, 0.0], axis=-1)[scan.returned]
    np.testing.assert_allclose(away, 12.0, atol=1e-3)
    assert np.ptp(scan.ranges[scan.returned]) > 0.5


@pytest.mark.parametrize(
    ("times", "stated", "expected"),
    [
        (np.arange(1084), 1085, 1084),
        (np.delete(np.arange(1084), [7, 8, 500]), 1085, 1084),
        (np.arange(1084), 1042, 1042),
        (np.arange(1084), None, None),
        (np.random.default_rng(0).uniform(0, 1084, 30_000), 1085, 1085),
        (np.zeros(9), 1085, 1085),
        (None, 1085, 1085),
    ],
)
def test_a_revolution_has_the_firings_that_the_times_of_its_returns_tell(times, stated, expected):
    offsets_s = None if times is None else 46.08e-6 * times
    assert firings(LidarReturns(np.zeros((9, 3)), offsets_s=offsets_s), stated) == expected


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        pytest.param({"leave_out": ("ring",)}, "rings", id="no rings and unknown beams"),
        pytest.param({"x": np.full(4 * STEPS, np.nan)}, "no return", id="no finite point"),
        pytest.param({"intensity": np.full(4 * STEPS, np.nan)}, "an intensity is not finite", id="an intensity of NaN"),
        pytest.param(dict.fromkeys("xyz", np.zeros(4 * STEPS)), "needs", id="ranges of zero"),
        pytest.param(None, "is missing", id="missing"),
    ],
)
def test_a_sweep_that_gives_no_scan_stops_and_is_named_or_is_left_out(columns, reason, tmp_path, caplog):
    scene = drive_of(tmp_path, [room(), room(), room()], lidar=Lidar("top", None, STEPS))
    bad = tmp_path / "1.npz"
    bad.unlink() if columns is None else write_returns(bad, room(), **columns)
    with pytest.raises(DatasetError, match=f"1\\.npz.*{reason}"):
        scan_records(scene, job())
    with caplog.at_level(logging.WARNING):
        records = scan_records(scene, job(on_missing="warn"))
    assert [scan.sample_index for scan in records.scans] == [0, 2]
    assert any("1.npz" in line and reason in line for line in caplog.messages)
    assert "1 of 3 sweeps of LiDAR top give no scan; they are left out" in caplog.messages


def test_a_drive_without_lidar_is_refused_in_a_sentence():
    with pytest.raises(
        DatasetError, match=r"scene hand has no LiDAR sweep that gives a scan.* tracks: discovered other"
    ):
        scan_records(scene_of([]), job())


def test_a_sweep_without_intensities_and_one_with_duplicated_azimuths_are_scans(tmp_path):
    scene = drive_of(tmp_path, [room(), room()])
    write_returns(tmp_path / "0.npz", room(), leave_out=("intensity",))
    with np.load(tmp_path / "1.npz") as arrays:
        twice = {name: np.concatenate([arrays[name], arrays[name]]) for name in arrays.files}
    for axis in "xyz":
        twice[axis][4 * STEPS :] *= 1.5  # a second return behind the first
    np.savez(tmp_path / "1.npz", **twice)
    for lidar in (LIDAR, Lidar("top")):
        first, second = scan_records(dataclasses.replace(scene, lidars=(lidar,)), job()).scans
        assert first.scan.intensities is None and first.scan.returned.all()
        assert second.scan.rays.shape == (len(BEAMS), STEPS)
        np.testing.assert_allclose(second.scan.ranges, 12.0, rtol=1e-5)


@pytest.fixture(scope="module")
def range_images(tiny_root, tmp_path_factory):
    """The tiny drive as Waymo records it, and its scene."""
    drive, _ = tiny_drive(tiny_root)
    source = drives.source(dataset="mine", reader="waymo", version="", scene=NAME, cameras=("FRONT",), sweeps=False)
    root = write_v2(tmp_path_factory.mktemp("v2"), drive)
    return drive, extract_scene(source, root, None, tmp_path_factory.mktemp("results"))


def test_range_images_give_their_own_rays(range_images):
    """Each ray of TOP starts where the vehicle was when its column fired, and ends at the recorded surface."""
    drive, scene = range_images
    records = scan_records(scene, job())
    assert list(dict.fromkeys(scan.lidar for scan in records.scans)) == [lidar.name for lidar in scene.lidars]
    found = next(s for s in records.scans if s.lidar == "TOP" and s.sample_index == 3)
    truth = next(r for r in drive.sweeps if r.laser == 1 and r.frame == found.timestamp)
    np.testing.assert_array_equal(found.scan.returned, truth.values[..., 0] > 0)
    np.testing.assert_allclose(found.scan.intensities[found.scan.returned], np.tanh(0.25), atol=1e-6)
    columns = found.scan.rays.shape[1]
    expected = SWEEP_S * ((np.arange(columns) + 0.5) / columns - 0.5)
    np.testing.assert_allclose(found.scan.rays.offsets_s, np.tile(expected, (64, 1)), atol=1e-6)
    local = found.scan.rays.directions() * found.scan.ranges[..., None]
    moved = local + found.linear * found.scan.rays.offsets_s[..., None]
    ends = moved @ found.sensor_to_world[:3, :3].T + found.sensor_to_world[:3, 3]
    off = np.linalg.norm(ends + scene.origin - truth.hits, axis=-1)[found.scan.returned]
    assert off.max() < 0.03, "the columns of the drive fire in blocks: up to 2.5 ms, 2 cm, apart"
    low = next(s for s in records.scans if s.lidar != "TOP")
    assert not low.scan.rays.offsets_s.any(), "unknown times: all at the timestamp"


def test_a_damaged_range_image_is_named(range_images, tmp_path):
    _, scene = range_images
    sweep = next(s for s in scene.sweeps if s.lidar == "TOP")
    with np.load(sweep.path) as arrays:
        columns = {name: arrays[name] for name in arrays.files if name != "azimuth"}
    path = tmp_path / "top.npz"
    np.savez(path, **columns)
    damaged = dataclasses.replace(scene, sweeps=(dataclasses.replace(sweep, path=str(path)),))
    with pytest.raises(DatasetError, match=r"LiDAR file .*top\.npz is corrupt \(.*azimuth"):
        scan_records(damaged, job())
