"""LiDAR scans of edited drives and from beside the recorded path, and the files that hold them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hand_made_street import AHEAD, DRIVERS, GONE, TURNING, checkpoint_of, straight, street_model
from helpers.scanned_street import LIDAR_LOGITS, SPEED, UNMEASURED, WALL_AT, parked_truck, scan_records, scanned_street
from plyfile import PlyData

from drivesplat.editing.scan_folder import ScanRenderPlan, SimulatedScan, scan_render_plan, write_scan_folder
from drivesplat.errors import ConfigError, ResultError
from drivesplat.lidar.moved_sensor import sensor_poses_of
from drivesplat.lidar.scans import scan_of
from drivesplat.model.scans import view_of_scan
from drivesplat.model.splat_model import SplatModel
from drivesplat.readers.nuscenes.sweep_file import read_file
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scan_record import NO_OBJECT, ScanRecords
from drivesplat.scene.scene import Scene
from drivesplat.scene.sensors import Lidar, LidarReturns
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.export import ScanFolderJob
from drivesplat.settings.render import TrajectorySettings

CPU, SPREAD = torch.device("cpu"), (3e-4, 3e-4)
SOURCE = {"scene": "0001", "method": "street_lidar", "trajectory": "left"}
LEFT = rigid(np.eye(3), np.array([0.0, 2.0, 0.0]))
SECOND = 2
"""A scan at 1.035 s."""


def a_job(*steps: dict[str, Any], formats: tuple[str, ...] = ("npz",), **trajectory: float) -> ScanFolderJob:
    return ScanFolderJob(
        eval_camera="CAM_FRONT",
        formats=formats,
        edit=Edit.model_validate({"steps": steps}) if steps else None,
        trajectory=None if steps else TrajectorySettings(**trajectory),
    )


@pytest.fixture(scope="module")
def lidar_model(scene) -> SplatModel:
    return scanned_street(scene)


@pytest.fixture(scope="module")
def records(scene) -> ScanRecords:
    return scan_records(scene)


def driven(scene: Scene, model: SplatModel, records: ScanRecords, job: ScanFolderJob) -> ScanRenderPlan:
    return scan_render_plan(scene, model, records.scans, job, "here")


def simulated(
    scene: Scene, model: SplatModel, records: ScanRecords, job: ScanFolderJob, number: int = SECOND
) -> tuple[SimulatedScan, list[str]]:
    """One scan, and the ids of the objects that it may meet."""
    drive = driven(scene, model, replace(records, scans=records.scans[number : number + 1]), job)
    (found,) = drive.simulated(SPREAD)
    return found, [item["id"] for item in drive.objects()]


def met(found: SimulatedScan, names: list[str], name: str) -> np.ndarray:
    """The returns of an object in world coordinates."""
    return found.places()[0][found.objects[found.returned] == names.index(name)]


def test_along_the_recorded_path_a_scan_is_that_of_the_model(scene, lidar_model, records):
    found, _ = simulated(scene, lidar_model, records, a_job())
    recorded = records.scans[SECOND]
    picture = lidar_model.scan(view_of_scan(recorded, SPREAD, CPU))
    np.testing.assert_allclose(found.rendered.ranges, picture.range, atol=1e-4)
    np.testing.assert_allclose(1.0 - found.rendered.drops, picture.returned, atol=1e-4)
    np.testing.assert_allclose(found.rendered.intensities, picture.intensity, atol=1e-4)
    assert found.sensor is recorded
    assert found.returned.sum() > 200 and not found.returned[:, UNMEASURED].any()


def test_a_trajectory_moves_the_sensor_as_it_moves_cameras(scene, lidar_model, records):
    job = a_job(lateral=2.0, vertical=0.5, yaw=30.0)
    for sensor, recorded in zip(driven(scene, lidar_model, records, job).sensors, records.scans, strict=True):
        expected = recorded.sensor_to_world[:3, 3] + [0.0, 2.0, 0.5]
        np.testing.assert_allclose(sensor.sensor_to_world[:3, 3], expected, atol=1e-6)
        ahead = [np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0]
        np.testing.assert_allclose(sensor.sensor_to_world[:3, 0], ahead, atol=1e-6)
        np.testing.assert_allclose(sensor.sensor_to_world[:3, :3] @ sensor.linear, [SPEED, 0.0, 0.0], atol=1e-4)
        np.testing.assert_allclose(sensor.angular, 0.0, atol=1e-5)
    found, _ = simulated(scene, lidar_model, records, a_job(lateral=2.0))
    offsets = records.scans[SECOND].scan.rays.offsets_s[found.returned]
    np.testing.assert_allclose(found.places()[1][:, 1], 2.0, atol=1e-5)
    np.testing.assert_allclose(found.places()[1][:, 0] - found.sensor.sensor_to_world[0, 3], SPEED * offsets, atol=1e-4)
    wall = found.places()[0][found.objects[found.returned] == NO_OBJECT]
    assert (np.abs(wall[:, 0] - WALL_AT) < 0.2).sum() > 50, "others graze an edge and mix two surfaces"


def test_labels_are_the_actors_that_contribute_most_and_boxes_of_what_stands_in_the_static_part(
    scene, lidar_model, records
):
    found, names = simulated(scene, lidar_model, records, a_job(), number=4)  # the third actor is absent
    standing = {track.id for track in scene.tracks if track.id not in DRIVERS and not track.object_class.is_human}
    assert names[:3] == [*DRIVERS] and set(names[3:]) <= standing, "the walker has no Gaussians of its own"
    own = met(found, names, AHEAD)
    inside = np.abs(own - straight(2.035)[:3, 3]) < 0.5 * np.array(DRIVERS[AHEAD].size) + [0.8, 0.4, 0.4]
    assert inside.all(axis=1).sum() > 10 and inside.all(axis=1).mean() > 0.75, "others graze an edge"
    truck = parked_truck(scene)
    box = met(found, names, truck.id)
    assert len(box) > 5
    np.testing.assert_allclose(box[:, 0], truck.object_to_world[0][0, 3], atol=0.5)
    intensity = found.rendered.intensities
    for name, kind in ((AHEAD, "vehicle"), (truck.id, "wall")):
        rays = found.objects == names.index(name)
        expected = float(torch.tensor(LIDAR_LOGITS[kind][0]).sigmoid())
        assert np.median(intensity[rays]) == pytest.approx(expected, abs=0.03)
    assert (found.objects[~found.returned] == NO_OBJECT).all()


def test_edits_change_scans_and_their_labels(scene, lidar_model, records):
    recorded, names = simulated(scene, lidar_model, records, a_job())
    own = recorded.objects == names.index(AHEAD)
    steps = [{"duplicate": {"track": AHEAD, "as": "twin", "lateral": 3.5}}, {"remove": {"track": AHEAD}}]
    found, now = simulated(scene, lidar_model, records, a_job(*steps))
    assert now[:3] == [TURNING, GONE, "twin"]
    behind = found.returned & own & (found.objects == NO_OBJECT)
    assert behind.sum() > 5 and (found.rendered.ranges[behind] > recorded.rendered.ranges[behind] + 10.0).all()
    twin = met(found, now, "twin")
    assert len(twin) > 10 and np.median(twin[:, 1]) == pytest.approx(0.5 + 3.5, abs=0.6)


def test_the_sensor_follows_an_edited_ego_vehicle(scene, lidar_model, records):
    step = {"ego": {"lateral": -1.5, "start": 2.0, "duration": 1.0}}
    sensors = driven(scene, lidar_model, records, a_job(step)).sensors
    assert len(sensors) == len(records.scans), "the last is recorded 35 ms after the last image"
    for sensor, recorded in zip(sensors, records.scans, strict=True):
        aside = sensor.sensor_to_world[1, 3] - recorded.sensor_to_world[1, 3]
        if recorded.seconds <= 2.0:
            np.testing.assert_allclose(sensor.sensor_to_world, recorded.sensor_to_world, atol=1e-9)
            np.testing.assert_allclose(sensor.linear, recorded.linear, atol=1e-6)
        elif recorded.seconds >= 3.1:
            assert aside == pytest.approx(-1.5, abs=1e-6)
    turning = next(s for s in sensors if 2.5 < s.seconds < 2.6)
    velocity = turning.sensor_to_world[:3, :3] @ turning.linear
    assert velocity[1] < -1.5 and velocity[0] == pytest.approx(SPEED, rel=0.05)
    slow = driven(scene, lidar_model, records, a_job({"ego": {"speed": 0.5}})).sensors
    assert np.linalg.norm(slow[4].linear) == pytest.approx(0.5 * SPEED, rel=1e-3)
    fast = driven(scene, lidar_model, records, a_job({"ego": {"speed": 2.0}})).sensors
    assert [s.timestamp for s in fast] == [s.timestamp for s in records.scans if s.seconds <= 4.535 / 2.0]


@pytest.fixture(scope="module")
def folder(scene, lidar_model, records, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("aside") / "scans" / "scans.json"
    job = a_job(formats=("npz", "ply", "pcd.bin"), lateral=2.0)
    some = replace(records, scans=records.scans[1:3])
    checkpoint = checkpoint_of(lidar_model)
    write_scan_folder(scene, checkpoint, some, job, DeviceSettings(kind="cpu"), path, SOURCE, {"stage": "scan_folder"})
    return path.parent


def listed(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "scans.json").read_text())


def files_of(folder: Path, number: int = 1) -> dict[str, Path]:
    return {kind: folder / name for kind, name in listed(folder)["scans"][number]["files"].items()}


def test_the_npz_holds_every_ray(folder, scene, lidar_model, records):
    found, _ = simulated(scene, lidar_model, records, a_job(lateral=2.0))
    with np.load(files_of(folder)["npz"]) as arrays:
        held = dict(arrays)
    for name in ("azimuths", "elevations", "offsets_s"):
        np.testing.assert_array_equal(held[name], getattr(records.scans[SECOND].scan.rays, name))
    np.testing.assert_allclose(held["ranges"], found.rendered.ranges, atol=1e-4)
    np.testing.assert_allclose(held["drops"], found.rendered.drops, atol=1e-4)
    np.testing.assert_allclose(held["intensities"], found.rendered.intensities, atol=1e-4)
    for name, values in {
        "returned": found.returned,
        "objects": found.objects,
        "measured": found.sensor.measured,
    }.items():
        np.testing.assert_array_equal(held[name], values)
    np.testing.assert_allclose(held["sensor_to_world"], records.scans[SECOND].sensor_to_world @ LEFT, atol=1e-6)
    assert held["timestamp"] == records.scans[SECOND].timestamp


def test_the_ply_holds_returns_in_the_world_with_their_objects(folder, scene, lidar_model, records):
    found, names = simulated(scene, lidar_model, records, a_job(lateral=2.0))
    data = PlyData.read(str(files_of(folder)["ply"]))
    points = data["vertex"]
    assert [p.name for p in points.properties] == ["x", "y", "z", "intensity", "ring", "time", "object"]
    np.testing.assert_allclose(np.stack([points[axis] for axis in "xyz"], axis=1), found.places()[0], atol=1e-3)
    np.testing.assert_array_equal(points["object"], found.objects[found.returned])
    np.testing.assert_array_equal(points["ring"], np.nonzero(found.returned)[0])
    np.testing.assert_array_equal(points["time"], records.scans[SECOND].scan.rays.offsets_s[found.returned])
    note = json.loads(data.comments[0].removeprefix("drivesplat "))
    assert note == {"frame": "world", "objects": names, "timestamp": records.scans[SECOND].timestamp}


def test_the_dataset_s_own_format_is_read_as_the_scan_that_it_holds(folder, scene, lidar_model, records):
    found, _ = simulated(scene, lidar_model, records, a_job(lateral=2.0))
    path = files_of(folder)["pcd.bin"]
    returns, order = read_file(path), np.argsort(found.sensor.scan.rays.offsets_s[found.returned], kind="stable")
    offsets = found.sensor.scan.rays.offsets_s[found.returned][order].astype(float)
    np.testing.assert_allclose(
        returns.intensity, found.rendered.intensities[found.returned][order], atol=0.5 / 255 + 1e-4
    )
    np.testing.assert_array_equal(returns.rings, np.nonzero(found.returned)[0][order])
    sensor, world_to_sensor = sensor_poses_of(found.sensor), inverse(found.sensor.sensor_to_world)
    timed = LidarReturns(returns.points, returns.intensity, returns.rings, offsets)
    again = scan_of(timed, Lidar("top", azimuth_steps=240), lambda o: world_to_sensor @ sensor(o))
    assert again.returned.sum() == found.returned.sum()
    np.testing.assert_allclose(
        np.sort(again.ranges[again.returned]), np.sort(found.rendered.ranges[found.returned]), atol=1e-3
    )


def test_a_model_without_lidar_is_refused_in_one_sentence_and_leaves_no_file(scene, records, tmp_path):
    path = tmp_path / "scans" / "scans.json"
    with pytest.raises(
        ResultError, match=r"trained without LiDAR: .* street_lidar, or train it with train\.scans\.per_image above 0"
    ):
        write_scan_folder(
            scene, checkpoint_of(street_model()), records, a_job(), DeviceSettings(kind="cpu"), path, SOURCE, {}
        )
    assert not any(file.is_file() for file in tmp_path.rglob("*"))


def test_an_edit_of_an_unknown_track_is_refused(scene, lidar_model, records):
    with pytest.raises(ConfigError, match=r"^here, step 1 \(remove\): no editable track"):
        driven(scene, lidar_model, records, a_job({"remove": {"track": "nobody"}}))


def test_without_cameras_a_trajectory_moves_the_sensor_and_an_edit_is_refused(scene, lidar_model, records):
    alone, some = replace(scene, frames=()), replace(records, scans=records.scans[1:3])
    job = a_job(lateral=2.0).model_copy(update={"eval_camera": None})
    for sensor, recorded in zip(driven(alone, lidar_model, some, job).sensors, some.scans, strict=True):
        np.testing.assert_allclose(sensor.sensor_to_world, recorded.sensor_to_world @ LEFT, atol=1e-4)
    job = a_job({"remove": {"track": AHEAD}}).model_copy(update={"eval_camera": None})
    with pytest.raises(ConfigError, match=r"^here: scans of edits need images, and the scene has no camera$"):
        driven(alone, lidar_model, some, job)
