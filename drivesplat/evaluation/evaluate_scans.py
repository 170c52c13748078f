"""The stage `evaluate_scans`: renderings of a scene without cameras compared with its held-out LiDAR scans."""

from dataclasses import dataclass
from typing import Any

from drivesplat.evaluation.eval_record import holdout_figures, rate_figures, summarize_swept_drive, training_figures
from drivesplat.evaluation.metrics import with_gap
from drivesplat.evaluation.scan_evaluation import lidar_metrics
from drivesplat.io.storage import Provenance
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model, read_checkpoint
from drivesplat.scene.regions import REGIONS
from drivesplat.scene.scan_record import ScanRecords, read_scans
from drivesplat.scene.scene import Scene, read_scene
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.scene.training_record import TrainingRecord, read_training_record
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.evaluate import EvaluateScansJob

UNAVAILABLE = "the scene has no camera"
"""Why there are no figures of images."""


@dataclass(frozen=True)
class ScanEvaluationInputs:
    """The inputs of an evaluation without cameras: the contents of checkpoint.npz, train.json, scene.json, parser.npz
    and scans.npz."""

    checkpoint: TrainedCheckpoint
    summary: dict[str, Any]
    scene: Scene
    record: TrainingRecord
    scans: ScanRecords


def read_scan_evaluation_inputs(
    scene: str, parser: str, checkpoint: str, summary: dict[str, Any], scans: str
) -> tuple[ScanEvaluationInputs, list[Provenance]]:
    """Reads the inputs of an evaluation without cameras from files; `summary` is the content of train.json. Returns
    them with the provenances of these files."""
    inputs = ScanEvaluationInputs(
        read_checkpoint(checkpoint), summary, read_scene(scene), read_training_record(parser), read_scans(scans)
    )
    read = (inputs.scene, inputs.record, inputs.checkpoint, inputs.scans)
    return inputs, [record.provenance for record in read]


def evaluate_scans(
    inputs: ScanEvaluationInputs, job: EvaluateScansJob, device_settings: DeviceSettings
) -> dict[str, Any]:
    """The content of a method's eval.json, without provenance: figures of LiDAR, and null for those of images."""
    model, device = open_model(inputs.checkpoint, device_settings)
    spread = inputs.checkpoint.job.train.scans.beam_spread_rad
    with explain_out_of_memory(lambda: len(model)):
        lidar = lidar_metrics(model, inputs.scene, inputs.scans, spread, device)
    of_images = with_gap(dict.fromkeys(REGIONS))
    record = inputs.record
    return {
        "schema": 1,
        "scene": record.scene.name,
        "dataset": record.scene.dataset,
        "protocol": scan_protocol(inputs, job),
        "drive": summarize_swept_drive(inputs.scene),
        "result": {
            **{group: {**of_images, "lidar": lidar[group]} for group in HELD_OUT_GROUPS},
            "images_unavailable": UNAVAILABLE,
            "tracks": job.tracks,
            **training_figures(inputs.summary),
            "findings": {"static_above_22_db": None, "vehicle_below_18_db": None},
            "shown": None,
        },
    }


def scan_protocol(inputs: ScanEvaluationInputs, job: EvaluateScansJob) -> dict[str, Any]:
    """The protocol of every figure, with the keys of a scene with cameras, the number of training scans, and
    `rate_figures` of scans."""
    record, scans = inputs.record, inputs.scans
    rate, training = record.scene.key_frame_hz, scans.of_group("train")
    held_out = [scan for group in HELD_OUT_GROUPS for scan in scans.of_group(group)]
    return {
        "version": record.scene.version,
        "cameras": [],
        "eval_camera": None,
        "width": None,
        "height": None,
        "sweeps": False,
        "holdout": holdout_figures(job.holdout, rate),
        "held_out_frames": record.held_out_frames,
        "train_images": 0,
        "train_scans": len(training),
        "poses": record.scene.poses,
        "regions": "boxes",
        "visibility": None,
        "own_car": None,
        "extra_points": None,
        "lidar_missing": missing_sweeps(inputs.scene, scans),
        "images_missing": 0,
        "key_frame_range": record.scene.key_frame_range,
        **rate_figures(rate, [scan.timestamp for scan in held_out], [scan.timestamp for scan in training]),
    }


def missing_sweeps(scene: Scene, scans: ScanRecords) -> int:
    """The number of sweeps at key frames that gave no scan."""
    known = {(scan.lidar, scan.timestamp) for scan in scans.scans}
    return sum((sweep.lidar, sweep.timestamp) not in known for sweep in scene.sweeps if sweep.is_key_frame)
