"""A world that uses every output: 10 key frames a second, class maps, LiDAR truth, a held-out camera, an edit."""

import dataclasses
import json
import shutil
from collections import namedtuple

import numpy as np
import pytest
from helpers.demo_worlds import CAMERAS, LIDAR, edit_of, job_of, world_of
from helpers.drives import scene_at
from PIL import Image

from drivesplat.errors import ResultError
from drivesplat.preprocess.masks import make_masks
from drivesplat.preprocess.scans import scan_records
from drivesplat.readers.truth import Truth, read_truth
from drivesplat.scene.masks import mask_name
from drivesplat.scene.scan import wrapped
from drivesplat.scene.scene import Scene
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.masks import MaskJob
from drivesplat.settings.scans import ScanSettings, ScansJob
from drivesplat.world.generate import make_world
from drivesplat.world.recorder import STREET_TO_GLOBAL, Recorder
from drivesplat.world.tokens import instance_token

pytestmark = pytest.mark.slow

KEY_FRAMES = 7
AHEAD = instance_token("demo", "vehicle 0")
JOB = job_of(
    world_of(
        key_frames=KEY_FRAMES, key_frame_hz=10, image_hz=20, lidar_hz=20, sweeps=("CAM_FRONT",), class_maps=True,
        readout_s=0.03, lidar={"spins": True}, wet=True,
        truth={"lidar": True, "cameras": ["CAM_FRONT", "CAM_FRONT_LEFT"], "lateral_m": [2.0, 2.0, 0.0]},
    ),
    {"gone": edit_of({"remove": {"track": AHEAD}})},
)  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("outputs")
    make_world(folder, JOB, {"stages": {}}, workers=2)
    return folder


@pytest.fixture(scope="module")
def scene(root) -> Scene:
    return scene_at(root, dataset="demo", scene="demo", on_missing="stop")


@pytest.fixture(scope="module")
def truth(root) -> Truth:
    return read_truth(root / "truth/truth.json")


@pytest.fixture(scope="module")
def recorder() -> Recorder:
    return Recorder(JOB.world, edits=JOB.edits)


def table(root, name: str) -> list[dict]:
    return json.loads((root / "v1.0-mini" / f"{name}.json").read_text())


def png(path) -> np.ndarray:
    return np.asarray(Image.open(path))


def test_the_tables_state_shutter_beams_and_spin(root, scene, recorder):
    (camera,), (lidar,) = scene.cameras, scene.lidars
    assert (camera.readout_s, camera.readout_direction) == (0.03, "down")
    assert lidar.azimuth_steps == 1085 and lidar.spin is not None
    np.testing.assert_allclose(lidar.spin.offsets_s(np.pi / 2 - recorder.pattern.azimuths), recorder.pattern.offsets)
    np.testing.assert_allclose(np.degrees(lidar.beam_elevations), np.linspace(-30.67, 10.67, 32), atol=1e-9)
    sensors = {row["token"]: row for row in table(root, "sensor")}
    assert {row["channel"] for row in sensors.values()} == {"CAM_FRONT", "LIDAR_TOP"}


def test_the_stage_masks_reads_class_and_sky_maps(root, scene, tmp_path):
    folders = {f"{kind}_folder": str(root / kind) for kind in ("semantic", "sky")}
    job = MaskJob.model_validate({"masks": folders, "holdout": {}, "images": {}})
    record = make_masks(scene, job, tmp_path)
    assert record.sky == "masks" and record.sky_known and 0.02 < record.sky_share < 0.9
    for frame in scene.frames:
        stem = frame.image_path.rsplit("/")[-1].removesuffix(".jpg")
        for kind in ("semantic", "sky"):
            made = png(tmp_path / mask_name(kind, frame.camera, frame.timestamp))
            np.testing.assert_array_equal(made, png(root / kind / "CAM_FRONT" / f"{stem}.png"))
    classes = np.stack([png(path) for path in (root / "semantic/CAM_FRONT").iterdir()])
    assert record.semantic_classes == classes[classes != 255].max() + 1


def test_a_held_out_camera_has_truth_with_images_and_records_nothing(root, truth):
    channels = {row["channel"] for row in table(root, "sensor")}
    assert channels & set(CAMERAS) == {"CAM_FRONT"}
    assert {path.name for path in (root / "samples").iterdir()} == {"CAM_FRONT", "LIDAR_TOP"}
    known = {row["token"] for row in table(root, "sample_data")}
    view = truth.recorded("CAM_FRONT_LEFT")
    assert len(view.frames) == KEY_FRAMES and not known & set(view.by_image())
    for frame in view.frames:
        assert png(root / "truth" / frame.image).shape == (54, 96, 3)


def test_the_edited_truth_lacks_the_removed_vehicle(root, truth):
    number = next(int(n) for n, token in truth.instances.items() if token == AHEAD)
    edited = next(view for view in truth.views if view.edit == "gone" and view.camera == "CAM_FRONT")
    without = truth.without_leading("CAM_FRONT")
    for frame, same in zip(edited.frames, without.frames, strict=True):
        instances = png(root / "truth" / frame.instances)
        assert not (instances == number).any()
        np.testing.assert_array_equal(instances, png(root / "truth" / same.instances))
        np.testing.assert_array_equal(png(root / "truth" / frame.image), png(root / "truth" / same.image))


def test_scans_hold_every_ray_and_returns_lie_where_range_pattern_and_poses_say(root, truth, recorder):
    """Range along each ray from the sensor's place at the ray's own time, within the noise of 2 cm."""
    views = ((0.0, None, None), (2.0, None, None), (0.0, None, AHEAD), (0.0, "gone", None))
    assert [(scan.left_m, scan.edit, scan.without) for scan in truth.scans] == [
        view for view in views for _ in range(KEY_FRAMES)
    ]
    pattern, files = np.load(root / "truth" / truth.pattern), {row["token"]: row for row in table(root, "sample_data")}
    np.testing.assert_array_equal(pattern["offsets"], recorder.pattern.offsets)
    assert (pattern["elevations"].shape, pattern["azimuths"].shape) == ((32,), (1085,))
    for scan in truth.scans[:KEY_FRAMES:5]:
        rays = np.load(root / "truth" / scan.file)
        assert {rays[name].shape for name in ("range", "intensity", "instance", "returned")} == {(32, 1085)}
        beam, step = np.nonzero(rays["returned"])
        points = np.fromfile(root / files[scan.token]["filename"], np.float32).reshape(-1, 5).astype(float)
        np.testing.assert_array_equal(points[:, 4], beam)
        lost = np.isinf(rays["range"])
        assert lost.any() and not rays["returned"][lost].any() and (rays["instance"][lost] == 0).all()
        e, a, seconds = pattern["elevations"][beam], pattern["azimuths"][step], 0.1 * scan.key_frame
        local = np.stack([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)], axis=-1)
        poses = recorder.ego_to_street(seconds + pattern["offsets"]) @ LIDAR.sensor_to_ego
        to_timestamp = np.linalg.inv(recorder.ego_pose(seconds) @ LIDAR.sensor_to_ego) @ poses
        expected = np.einsum("nij,nj->ni", to_timestamp[step, :3, :3], rays["range"][beam, step, None] * local)
        error = np.linalg.norm(points[:, :3] - expected - to_timestamp[step, :3, 3], axis=1)
        assert error.max() < 0.12 and np.sqrt((error**2).mean()) == pytest.approx(0.02, rel=0.05)


def test_scans_of_one_sweep_from_elsewhere_and_without_the_vehicle_ahead(root, truth, recorder):
    recorded, left, without = (truth.scans_of(*view) for view in ((), (2.0,), (0.0, AHEAD)))
    assert recorded.keys() == left.keys() == without.keys() and truth.left_of_scans == [2.0]
    number = next(int(n) for n, token in truth.instances.items() if token == AHEAD)
    for token, scan in recorded.items():
        moved = np.linalg.inv(np.array(scan.sensor_to_global)) @ np.array(left[token].sensor_to_global)
        aside = LIDAR.sensor_to_ego[:3, :3] @ moved[:3, 3]
        np.testing.assert_allclose(aside, [0.0, 2.0, 0.0], atol=1e-6)
        assert without[token].sensor_to_global == scan.sensor_to_global
        before, after = (np.load(root / "truth" / one[token].file) for one in (recorded, without))
        met = before["instance"] == number
        assert met.sum() > 50 and not (after["instance"] == number).any()
        assert (after["range"][met] > before["range"][met]).all()
        np.testing.assert_array_equal(after["range"][~met], before["range"][~met])
    first = next(iter(recorded.values()))
    pose = STREET_TO_GLOBAL @ recorder.ego_pose(0.1 * first.key_frame) @ LIDAR.sensor_to_ego
    np.testing.assert_allclose(first.sensor_to_global, pose, atol=1e-9)


def test_the_stage_scans_finds_the_rays_of_the_truth_and_what_they_met(root, scene, truth):
    """Which of them returned, their ranges within the noise, and the vehicles that they met. A few returns of a surface
    lie outside of its box by the noise."""
    job = ScansJob(scans=ScanSettings(), holdout=HoldoutSettings(), own_car_radius=0.0, on_missing="stop")
    pattern, token = np.load(root / "truth" / truth.pattern), truth.scans[3].token
    index = [sweep.token for sweep in scene.sweeps].index(token)
    one = dataclasses.replace(scene, sweeps=(scene.sweeps[index - 1], scene.sweeps[index], scene.sweeps[index + 1]))
    records = scan_records(one, job)
    record, rays = records.scans[1], np.load(root / "truth" / truth.scans[3].file)
    azimuths = np.angle(np.exp(1j * record.scan.rays.azimuths.astype(float)).mean(axis=0))
    columns = np.abs(wrapped(azimuths[:, None] - (np.pi / 2 - pattern["azimuths"]))).argmin(axis=0)
    returned = rays["returned"]
    both = record.scan.returned[:, columns] & returned
    assert (record.scan.returned[:, columns] != returned).mean() < 0.001, "where the revolution begins"
    noise = (record.scan.ranges[:, columns] - rays["range"])[both]
    assert np.abs(np.median(noise)) < 0.005 and np.median(np.abs(noise)) < 0.02
    off = np.abs(record.scan.intensities[:, columns] - rays["intensity"])
    assert (off[both] > 0.003).mean() < 0.001
    numbers = {records.tracks.index(track): int(n) for n, track in truth.instances.items() if track in records.tracks}
    found = np.vectorize(lambda i: numbers.get(i, 0))(record.objects[:, columns])
    dynamic = [numbers[i] for i, t in enumerate(scene.tracks) if t.object_class.is_dynamic and i in numbers]
    met = both & np.isin(rays["instance"], dynamic)
    assert met.sum() > 300 and (found == rays["instance"])[met].mean() > 0.9


Usage = namedtuple("Usage", "total used free")


def test_a_world_larger_than_the_free_space_is_refused_before_anything_is_recorded(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**9, 10**9 - 1000, 1000))
    with pytest.raises(ResultError) as refused:
        make_world(tmp_path, JOB, {"stages": {}})
    message = str(refused.value)
    assert message.startswith(f"{tmp_path}: the world takes about 0.0 GB, 0.0 GB are free; free some space")
    assert "\n" not in message and "datasets.<name>.dataroot" in message
    assert not (tmp_path / "samples").exists() and not (tmp_path / "v1.0-mini").exists()
