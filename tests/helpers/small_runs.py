"""A tiny drive from its tables to the metrics of all methods, stage by stage in this process, with the settings that
the workflow would give each stage."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from drivesplat.evaluation.evaluate import EvaluationInputs, evaluate_method
from drivesplat.evaluation.scene_metrics import side_by_side
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.preprocess.actor_seed import actors_record
from drivesplat.preprocess.extract import extract_scene
from drivesplat.preprocess.lidar_depth import lidar_depths
from drivesplat.preprocess.lidar_seed import seed_points
from drivesplat.preprocess.masks import make_masks
from drivesplat.preprocess.parser import training_record
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.settings import Settings
from drivesplat.settings.actor_seed import ActorSeedJob
from drivesplat.settings.config import Config, load
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.settings.extract import SceneSource
from drivesplat.settings.images import ParserJob
from drivesplat.settings.lidar_depth import LidarDepthJob
from drivesplat.settings.lidar_seed import SeedJob
from drivesplat.settings.masks import MaskJob
from drivesplat.settings.train import TrainJob
from drivesplat.training.stage import TrainingFiles, TrainingInputs, run_training
from drivesplat.visuals.rendered_view import ModelWithRecording, open_model_with_recording
from drivesplat.workflow.stages import stage_settings
from helpers.trainings import PROVENANCE
from helpers.workflow_copy import TINY_TRAINING

S = TypeVar("S", bound=Settings)
SCENE = "0001"
CPU = DeviceSettings(kind="cpu")
HELD_TO_SKY_AND_DEPTH = {"train": {"sky_bce_weight": 0.05, "depth_weight": 0.01}}
BASE = {
    "datasets": {"nuscenes": {"scenes": [SCENE]}},
    "methods": {"vanilla": {}, "street": {"parts": ["background", "actors"], "overrides": HELD_TO_SKY_AND_DEPTH}},
    "holdout": {"every_nth": 4, "offset": 2, "last_block": 1},
    "lidar_seed": {"max_points": 500, "far_points": 100},
    "actors": {"random_points": 200},
    "train": TINY_TRAINING | {"iterations": 20},
    "render": {"width": 64, "height": 36, "fps": 4},
    "lpips": {"enabled": False},
}


@dataclass(frozen=True)
class Finished:
    """A drive's metrics.json, provenance aside, and per method the trained model with the recording; each training has
    left its files in a folder of the method's name in `folder`."""

    folder: Path
    config: Config
    metrics: dict[str, Any]
    drives: dict[str, ModelWithRecording]

    def job(self, stage: str, kind: type[S], method: str | None = None, film: str | None = None) -> S:
        """The settings of a stage."""
        return settings_of(self.config, stage, kind, method, film)


def settings_of(config: Config, stage: str, kind: type[S], method: str | None = None, film: str | None = None) -> S:
    """The settings that a stage of the tiny drive gets of a config."""
    return kind.model_validate_json(stage_settings(config, stage, SCENE, method, film))


def run(root: Path, folder: Path, **changes: Any) -> Finished:
    """Runs all stages of the tiny drive in `root` with the config of BASE and `changes`."""
    made = Finished(folder, load({**BASE, **changes}), {}, {})
    scene = extract_scene(made.job("extract", SceneSource), root)
    masks = make_masks(scene, made.job("masks", MaskJob), folder / "masks")
    parser = training_record(scene, seed_points(scene, made.job("lidar_seed", SeedJob)), made.job("parser", ParserJob))
    actors = actors_record(scene, made.job("actors", ActorSeedJob)).actors
    depths = lidar_depths(scene, made.job("lidar_depth", LidarDepthJob))
    recording, known = EvaluationData(scene, parser, folder / "masks"), {"sky_known": masks.sky_known}
    evals = {}
    for method, settings in made.config.methods.items():
        moving = (actors, depths) if "actors" in settings.parts else ([], [])
        files = TrainingFiles(folder / method / "checkpoint.npz", folder / method / "train.json")
        inputs = TrainingInputs(parser, folder / "masks", *moving, **known)
        run_training(inputs, made.job("train", TrainJob, method), CPU, files, PROVENANCE, method)
        checkpoint, summary = read_checkpoint(files.checkpoint), json.loads(files.summary.read_text())
        measured = EvaluationInputs(checkpoint, summary, recording, masks, None, None)
        evals[method] = evaluate_method(measured, made.job("evaluate", EvaluateJob, method), CPU).record
        made.drives[method] = open_model_with_recording(checkpoint, recording, CPU)
    made.metrics.update(side_by_side(evals))
    return made
