"""A drive without cameras from its tables to its figures, stage by stage."""

import dataclasses
import json
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import pytest
from helpers.small_runs import CPU, HELD_TO_SKY_AND_DEPTH, PROVENANCE, SCENE
from helpers.swept_street import write_swept_street
from helpers.workflow_copy import TINY_TRAINING

from drivesplat.errors import DatasetError
from drivesplat.evaluation.evaluate_scans import ScanEvaluationInputs, evaluate_scans, missing_sweeps
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.preprocess.actor_seed import actors_record
from drivesplat.preprocess.extract import extract_scene
from drivesplat.preprocess.parser import training_record
from drivesplat.preprocess.scans import scan_records
from drivesplat.scene.regions import REGIONS
from drivesplat.scene.scan_record import ScanRecords
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings import Settings
from drivesplat.settings.actor_seed import ActorSeedJob
from drivesplat.settings.config import load
from drivesplat.settings.evaluate import EvaluateScansJob
from drivesplat.settings.extract import SceneSource
from drivesplat.settings.images import ParserJob
from drivesplat.settings.method import merged
from drivesplat.settings.scans import ScansJob
from drivesplat.settings.train import TrainJob
from drivesplat.training.stage import TrainingFiles, TrainingInputs, run_training
from drivesplat.workflow.stages import stage_settings

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("without_cameras")]
S = TypeVar("S", bound=Settings)
METHOD = "with_lidar"
CONFIG = {
    "datasets": {"mine": {"reader": "drive", "scenes": [SCENE]}},
    "cameras": [],
    "methods": {
        METHOD: {
            "parts": ["background", "actors"],
            "overrides": merged(HELD_TO_SKY_AND_DEPTH, {"train": {"scans": {"per_image": 0.25, "points": 1500}}}),
        }
    },
    "holdout": {"every_nth": 4, "offset": 2, "last_block": 1},
    "actors": {"random_points": 200},
    "train": TINY_TRAINING | {"iterations": 40, "image_every": 20, "psnr_every": 20},
}


def job(stage: str, kind: type[S], **changes: Any) -> S:
    return kind.model_validate_json(stage_settings(load({**CONFIG, **changes}), stage, SCENE, METHOD))


@dataclass(frozen=True)
class Measured:
    scene: Scene
    record: TrainingRecord
    scans: ScanRecords
    actors: list[Any]
    inputs: ScanEvaluationInputs
    eval: dict[str, Any]


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Measured:
    folder = tmp_path_factory.mktemp("alone")
    scene = extract_scene(job("extract", SceneSource), write_swept_street(folder / SCENE))
    scans, record = scan_records(scene, job("scans", ScansJob)), training_record(scene, None, job("parser", ParserJob))
    actors = actors_record(scene, job("actors", ActorSeedJob)).actors
    files = TrainingFiles(folder / "checkpoint.npz", folder / "train.json")
    inputs = TrainingInputs(record, None, actors, [], scans=scans.of_group("train"), sky_known=False)
    run_training(inputs, job("train", TrainJob), CPU, files, PROVENANCE, METHOD)
    summary = json.loads(files.summary.read_text())
    given = ScanEvaluationInputs(read_checkpoint(files.checkpoint), summary, scene, record, scans)
    found = evaluate_scans(given, job("evaluate_scans", EvaluateScansJob), CPU)
    return Measured(scene, record, scans, actors, given, found)


def test_its_record_has_no_image_and_the_splits_of_its_key_frames(measured):
    record = measured.record
    shapes = {"Ks": (0, 3, 3), "camtoworlds": (0, 4, 4), "image_sizes": (0, 2), "points": (0, 3), "points_rgb": (0, 3)}
    assert {name: getattr(record, name).shape for name in shapes} == shapes
    assert record.camera_names == record.image_paths == record.train_images == []
    assert record.held_out_frames == {"interpolation": [2, 6], "extrapolation": [7]}
    training = np.stack([scan.sensor_to_world[:3, 3] for scan in measured.scans.of_group("train")])
    assert record.scene_scale == pytest.approx(np.linalg.norm(training - training.mean(axis=0), axis=1).max())
    (car,) = measured.actors
    assert car.category == "car" and car.lidar_points > 50 and car.pixels == 0 and (car.points_rgb == 127).all()


def test_figures_are_those_of_lidar_alone(measured):
    result = measured.eval["result"]
    for group in HELD_OUT_GROUPS:
        assert {name: result[group][name] for name in (*REGIONS, "gap_db")} == dict.fromkeys((*REGIONS, "gap_db"))
        lidar = result[group]["lidar"]["all"]
        assert lidar["rays"] > 1000 and 0.0 < lidar["range_error_median_m"] < 2.0 and lidar["drop_accuracy"] > 0.4
    assert result["images_unavailable"] == "the scene has no camera" and result["shown"] is None
    assert result["gaussians"] > 100 and result["train_iterations"] == 40


def test_its_protocol_says_what_it_was_trained_on_and_counts_sweeps_that_gave_no_scan(measured):
    protocol = measured.eval["protocol"]
    assert protocol["cameras"] == [] and protocol["eval_camera"] is protocol["width"] is protocol["height"] is None
    assert protocol["train_images"] == 0 and protocol["train_scans"] == len(measured.scans.of_group("train"))
    assert protocol["held_out_frames"] == measured.record.held_out_frames
    assert "neighbourhood_s" not in protocol["holdout"], "two key frames a second"
    drive = measured.eval["drive"]
    assert drive["moved_m"] > 1.0 and drive["seconds"] > 1.0
    assert drive["interpolation"] is drive["extrapolation"] is None
    assert measured.eval["protocol"]["lidar_missing"] == 0 == missing_sweeps(measured.scene, measured.scans)
    fewer = dataclasses.replace(measured.scans, scans=measured.scans.scans[1:-1])
    assert missing_sweeps(measured.scene, fewer) == 2


def test_a_split_without_training_sweeps_is_refused(measured):
    with pytest.raises(DatasetError, match="no training sweep is left; hold out fewer key frames"):
        training_record(measured.scene, None, job("parser", ParserJob, holdout={"every_nth": 1, "offset": 0}))
