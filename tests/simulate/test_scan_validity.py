"""How far LiDAR scans from off the recorded path can be trusted, where it is known what training scans saw."""

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import REPOSITORY
from helpers.hand_made import about_z, round_gaussians
from helpers.hand_made_drive import BEAM_SPREAD, drive_of
from helpers.hand_made_street import AHEAD, street_actors, street_scene
from helpers.records import recorded_scan
from torch import nn

import drivesplat
from drivesplat.drive.lidars import PoseableLidar
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError, ResultError
from drivesplat.evaluation.scan_evaluation import rendered_scan
from drivesplat.evaluation.scan_metrics import scan_metrics
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scan import Scan, ScanRays
from drivesplat.scene.scan_record import RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene
from drivesplat.settings.simulate import RunJob, RunSettings, SimulationSettings
from drivesplat.simulate import scan_validity
from drivesplat.simulate.env import DriveEnv, vector_env
from drivesplat.simulate.run_stage import drive_runs
from drivesplat.simulate.scan_validity import DEFAULT_GROWTH, MAX_MAGNIFICATION, RESIDUALS, ScanKnowledge, ScanValidity
from drivesplat.simulate.simulation import Simulation
from drivesplat.simulate.trust import Trust
from drivesplat.simulate.validity import ViewValidity

LIDAR = PoseableLidar.spinning(np.radians(np.linspace(-14.0, 6.0, 8)), 120, revolution_s=0.0)
STEP_M, SCANS, HEIGHT = 4.0, 5, 1.8
"""Training scans stand at 0, 4, ... 16 m along x, half a second apart."""
WALL_AT = 20.0
"""Metres to the left of the path."""
ERROR = 0.05
"""Metres by which recorded ranges differ from rendered ones."""


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    return street_scene(tiny_scene)


def street(hidden: bool = False) -> SplatModel:
    """A wall to the left and one to the right, at twice the distance, actors between them, and perhaps a wall that
    stands behind the left one."""
    x, z = np.meshgrid(np.arange(-40.0, 64.0, 1.0), np.arange(-5.0, 9.0, 1.0))
    sides = [WALL_AT, -2.0 * WALL_AT, *([WALL_AT + 8.0] if hidden else [])]
    places = [np.stack([x.ravel(), np.full(x.size, side), z.ravel()], axis=1) for side in sides]
    static, actors = round_gaussians(np.concatenate(places), 0.8, 0.99), street_actors()
    with torch.no_grad():
        static.params["scales"][:, 1] = float(np.log(0.02))
        actors.params["scales"].fill_(float(np.log(0.2)))
        actors.params["opacities"].fill_(4.0)
    for part in (static, actors):
        logits = torch.zeros(len(part), 4, 2)
        logits[:, 0] = torch.tensor([0.0, 6.0])
        part.params["lidar_logits"] = nn.Parameter(logits)
    return SplatModel([static, actors], None).requires_grad_(False)


def scan_at(model: SplatModel, place: Sequence[float], number: int, error: float, group: str) -> RecordedScan:
    """A scan whose ranges are those of the model, and `error` metres more."""
    empty = np.zeros(LIDAR.rays.shape, dtype=np.float32)
    scan = recorded_scan(
        Scan(LIDAR.rays, empty > 0, empty, empty), rigid(np.eye(3), np.array([*place])), seconds=0.5 * number,
        sample_index=number, group=group, lidar="LIDAR_TOP",
    )  # fmt: skip
    found = rendered_scan(model, scan, BEAM_SPREAD, torch.device("cpu"))
    ranges = np.where(found.returned, found.ranges + error, 0.0).astype(np.float32)
    return dataclasses.replace(scan, scan=Scan(LIDAR.rays, found.returned, ranges, empty))


def drive_with(
    scene: Scene, folder: Path, held_out: Sequence[int] = (), error: float = ERROR, model: SplatModel | None = None
) -> TrainedDrive:
    """The street with these scans held out for interpolation, and the others for training."""
    made = street() if model is None else model
    groups = ["interpolation" if number in held_out else "train" for number in range(SCANS)]
    scans = [scan_at(made, (STEP_M * number, 0.0, HEIGHT), number, error, group) for number, group in enumerate(groups)]
    return drive_of(scene, made, folder, ScanRecords(scans, [track.id for track in scene.tracks]))


@pytest.fixture(scope="module")
def drive(scene, tmp_path_factory) -> TrainedDrive:
    return drive_with(scene, tmp_path_factory.mktemp("scanned"))


@pytest.fixture(scope="module")
def known(drive) -> ScanKnowledge:
    return ScanKnowledge.of_drive(drive)


def found_at(
    known: ScanKnowledge, place: Sequence[float], seconds: float = 1.5, lidar: PoseableLidar = LIDAR
) -> ScanValidity:
    world = known.drive.state(seconds)
    pose = rigid(np.eye(3), np.array([*place]))
    return known.validity(world, world.scan(lidar, sensor_to_world=pose, with_instance=False))


def facing(azimuth: float, half: float = 15.0) -> PoseableLidar:
    """The rays of LIDAR within so many degrees of an azimuth (degrees)."""
    turned = np.degrees(LIDAR.rays.azimuths[0]) - azimuth
    chosen = np.abs((turned + 180.0) % 360.0 - 180.0) < half
    rays = LIDAR.rays
    return PoseableLidar(ScanRays(rays.azimuths[:, chosen], rays.elevations[:, chosen], rays.offsets_s[:, chosen]))


# ---- what is expected


def test_a_scan_from_a_training_place_has_the_error_of_training_scans(known):
    found = found_at(known, (3 * STEP_M, 0.0, HEIGHT))
    assert known.error == pytest.approx(ERROR, abs=1e-4)
    assert found.distance == pytest.approx(0.0, abs=1e-5)
    assert found.expected_range_error == pytest.approx(ERROR, rel=0.02)
    assert found.interval == pytest.approx([found.expected_range_error * factor for factor in RESIDUALS])
    assert found.validity == pytest.approx(1.0, abs=0.02) and found.unseen < 0.01 and found.turned == 0.0


@pytest.mark.parametrize("nearer", [5.0, 12.0, 17.0])
def test_the_error_grows_with_the_magnification_as_documented(known, nearer):
    """Of the left wall alone, ahead of the sensor, nearer to it by so many metres than the nearest training scan."""
    beside = PoseableLidar(facing(90.0, half=2.0).rays)
    found = found_at(known, (3 * STEP_M, nearer, HEIGHT), lidar=beside)
    magnification = min(WALL_AT / (WALL_AT - nearer), MAX_MAGNIFICATION)
    expected = known.error * (1.0 + DEFAULT_GROWTH * np.sqrt(magnification - 1.0))
    assert known.growth == DEFAULT_GROWTH
    assert found.expected_range_error == pytest.approx(expected, rel=0.03)
    assert found.validity == pytest.approx(known.reference / expected, rel=0.03)


def test_validity_falls_as_the_sensor_moves_towards_a_wall(known):
    found = [found_at(known, (3 * STEP_M, metres, HEIGHT)) for metres in (0.0, 2.0, 5.0, 10.0, 15.0)]
    assert [one.distance for one in found] == pytest.approx([0.0, 2.0, 5.0, 10.0, 15.0], abs=1e-4)
    assert (np.diff([one.validity for one in found]) < -0.01).all()
    assert (np.diff([one.expected_range_error for one in found]) > 0.0).all()
    assert (np.diff([one.supported for one in found]) < 0.0).all()


def test_what_no_training_scan_saw_is_worth_nothing(scene, tmp_path):
    """A wall behind another one, seen from between the two."""
    known = ScanKnowledge.of_drive(drive_with(scene, tmp_path, model=street(hidden=True)))
    found = found_at(known, (3 * STEP_M, WALL_AT + 2.0, HEIGHT), lidar=facing(90.0))
    most = known.error * (1.0 + DEFAULT_GROWTH * np.sqrt(MAX_MAGNIFICATION - 1.0))
    assert found.unseen > 0.95 and found.validity < 0.02 and found.supported < 0.05
    assert found.expected_range_error == pytest.approx(most, rel=0.02)


def test_a_scan_without_returns_is_worth_nothing(known):
    found = found_at(known, (0.0, 0.0, 150.0))
    assert found.expected_range_error is None and found.interval is None
    assert found.validity == 0.0 == found.unseen and found.distance > 100.0


def test_an_object_that_is_turned_round_lowers_it(known):
    """A car beside the sensor, as it was and turned."""
    world, place = known.drive.state(1.5), np.array([3 * STEP_M, 0.0, HEIGHT])
    pose = rigid(np.eye(3), place + np.array([6.0, 0.0, -0.8]))
    found = []
    for turn in (0.0, np.pi):
        pose[:3, :3] = about_z(turn)
        world.actors[AHEAD].pose = pose
        scan = world.scan(facing(0.0), sensor_to_world=rigid(np.eye(3), place), with_instance=False)
        found.append(known.validity(world, scan))
    assert found[0].turned == 0.0 < 0.1 < found[1].turned
    assert found[1].validity < found[0].validity
    assert found[1].unseen == pytest.approx(found[0].unseen, abs=0.02)


def test_what_was_seen_of_an_edited_drive_is_that_of_the_recorded_one(known, drive):
    edited = ScanKnowledge.of_drive(drive.edited([{"shift": {"track": AHEAD, "yaw": 180.0}}]))
    assert (edited.error, edited.reference) == pytest.approx((known.error, known.reference))
    assert torch.equal(edited.gaussians.seen, known.gaussians.seen)
    ahead = facing(0.0, half=10.0)
    place = (3 * STEP_M - 6.0, 0.5, HEIGHT)
    assert found_at(edited, place, lidar=ahead).turned > found_at(known, place, lidar=ahead).turned == 0.0


# ---- what was held out


def write_metrics(drive: TrainedDrive, **medians: float) -> None:
    drive.folder.mkdir(exist_ok=True)
    result = {name: {"lidar": {"all": {"range_error_median_m": error}}} for name, error in medians.items()}
    content = {"protocol": {"eval_camera": "CAM_FRONT"}, "result": {"extrapolation": None, **result}}
    (drive.folder / "eval.json").write_text(json.dumps(content))


@pytest.mark.parametrize("measured", [1.4 * ERROR, 3.0 * ERROR, 0.8 * ERROR])
def test_held_out_scans_have_the_error_that_was_measured(scene, tmp_path, measured):
    """Whether or not the growth explains it."""
    drive = drive_with(scene, tmp_path, held_out=[2, 3])
    write_metrics(drive, interpolation=measured)
    known = ScanKnowledge.of_drive(drive)
    found = [found_at(known, (STEP_M * number, 0.0, HEIGHT), 0.5 * number) for number in (2, 3)]
    assert np.mean([one.expected_range_error for one in found]) == pytest.approx(measured, rel=0.01)
    assert np.mean([one.validity for one in found]) > 0.95


def test_training_scans_have_the_median_of_their_metrics(scene, drive, known):
    records = drive.recording.scans.of_group("train")
    pairs = ((scan, rendered_scan(drive.model, scan, BEAM_SPREAD, torch.device("cpu"))) for scan in records)
    assert known.error == pytest.approx(scan_metrics(scene, pairs, chamfer=False)["all"]["range_error_median_m"])


def test_invalid_metrics_are_named(scene, tmp_path):
    drive = drive_with(scene, tmp_path, held_out=[3])
    drive.folder.mkdir()
    (drive.folder / "eval.json").write_text(json.dumps({"result": {"interpolation": 3}}))
    with pytest.raises(ResultError, match=r"eval\.json: not a record of metrics"):
        ScanKnowledge.of_drive(drive)


def test_a_large_scan_is_judged_by_some_of_its_firings(known, monkeypatch):
    whole = found_at(known, (3 * STEP_M, 5.0, HEIGHT))
    monkeypatch.setattr(scan_validity, "MAX_RAYS", LIDAR.rays.azimuths.size // 4)
    some = found_at(known, (3 * STEP_M, 5.0, HEIGHT))
    assert some != whole
    assert some.expected_range_error == pytest.approx(whole.expected_range_error, rel=0.05)


# ---- in the closed loop


def test_a_policy_is_told_how_far_it_can_trust_the_scan(known, drive):
    env = DriveEnv(drive, cameras=(), lidar="LIDAR_TOP", validity=True, end_on_collision=False)
    _, on_path = env.reset(seed=0)
    for _ in range(12):
        seen, *_, aside = env.step(np.array([0.5, 0.0], dtype=np.float32))
    assert 0.0 < aside["scan_validity"] < on_path["scan_validity"] <= 1.0 and "validity" not in aside
    run = env.simulation
    scan = run.world().scan(run.lidar, ego_to_world=run.ego_to_world, velocity=run.place["velocity"])
    assert aside["scan_validity"] == known.validity(run.world(), scan).validity
    np.testing.assert_array_equal(seen["lidar"]["range"] > 0.0, scan.returned.numpy())


def test_the_example_of_the_guide_runs(drive, monkeypatch):
    page = (REPOSITORY / "docs/closed_loop.md").read_text()
    (example,) = (own for own in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL) if "scan_validity" in own)
    monkeypatch.setattr(drivesplat, "open", lambda folder: drive)
    names = {"drivesplat": drivesplat}
    exec(example, names)
    assert 0.0 < names["found"].validity <= 1.0


def test_environments_of_a_vector_share_what_tells_their_validity(drive, monkeypatch):
    made = []
    of_drive = ScanKnowledge.of_drive
    monkeypatch.setattr(ScanKnowledge, "of_drive", lambda of: made.append(of) or of_drive(of))
    envs = vector_env(drive, 3, cameras=(), lidar="LIDAR_TOP", validity=True, seconds=0.5)
    _, info = envs.reset(seed=1)
    assert len(made) == 1 and len(info["scan_validity"]) == 3
    envs.close()


def test_a_run_is_believed_until_its_scan_is_not(drive, tmp_path, monkeypatch):
    """Though its images are believed."""
    settings = SimulationSettings(cameras=(), lidar="LIDAR_TOP", seconds=0.5)
    job = RunJob(run=RunSettings(policy="recorded", film_width=64, simulation=settings), edit=None, code=None, crf=30)
    scan, believed = Trust.scan, ViewValidity(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, None, None, 0.0, 1.0)
    monkeypatch.setattr(Trust, "image", lambda *given: believed)
    monkeypatch.setattr(
        Trust, "scan", lambda own, now: dataclasses.replace(scan(own, now), validity=0.4 if now.steps > 2 else 0.6)
    )
    (episode,) = drive_runs(drive, job, tmp_path / "film.mp4")["episodes"]
    assert episode["scan_validity"] == [0.6, 0.6, 0.6, 0.4, 0.4, 0.4] and episode["validity"] == [1.0] * 6
    assert episode["believable_s"] == pytest.approx(0.3)
    assert len(episode["expected_range_error"]) == 6 and min(episode["expected_range_error"]) > 0.0


def test_validity_wants_a_sensor(drive):
    simulation = Simulation(drive, SimulationSettings(cameras=(), lidar="LIDAR_TOP", validity=True))
    simulation.lidar = None
    with pytest.raises(RequestError, match="name a camera in 'cameras', or a 'lidar'"):
        Trust(drive).inform(simulation)
    with pytest.raises(RequestError, match="has no LiDAR"):
        simulation.scan()


# ---- drives with little


def test_a_drive_without_training_scans_is_refused(scene, tmp_path):
    with pytest.raises(RequestError, match="has no training scan with returns"):
        ScanKnowledge.of_drive(drive_with(scene, tmp_path, held_out=range(SCANS)))


def test_a_drive_that_renders_no_lidar_is_refused(scene, tmp_path):
    drive = drive_with(scene, tmp_path)
    for part in drive.model.parts:
        del part.params["lidar_logits"]
    with pytest.raises(RequestError, match="renders no LiDAR"):
        ScanKnowledge.of_drive(drive)


def test_the_world_of_another_drive_is_refused(known, scene, tmp_path):
    world = drive_with(scene, tmp_path).state(1.0)
    scan = world.scan(LIDAR, sensor_to_world=rigid(np.eye(3), np.array([0.0, 0.0, HEIGHT])))
    with pytest.raises(RequestError, match="not one of"):
        known.validity(world, scan)
