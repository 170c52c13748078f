"""The stage `evaluate`: renderings compared with held-out images, by region."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.evaluation.backbone import read_backbone
from drivesplat.evaluation.eval_record import holdout_figures, rate_figures, summarize_drive, training_figures
from drivesplat.evaluation.image_metrics import (
    held_out_depths,
    held_out_images,
    measure_groups,
    measured_images,
    side_camera_metrics,
)
from drivesplat.evaluation.lpips_map import load_lpips
from drivesplat.evaluation.metrics import LpipsMap
from drivesplat.evaluation.scan_evaluation import lidar_metrics
from drivesplat.evaluation.scan_truth import ScanTruth, scan_truth_metrics
from drivesplat.evaluation.synthetic import DriveTruth, lateral_metrics, removal_metrics, rendered
from drivesplat.io.storage import Provenance
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model, read_checkpoint
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.scene.evaluation_data import EvaluationData, read_evaluation_data
from drivesplat.scene.masks import MasksRecord, read_masks_record
from drivesplat.scene.regions import region_mask
from drivesplat.scene.scan_record import ScanRecords, read_scans
from drivesplat.scene.splits import HELD_OUT_GROUPS, SIDE_CAMERA
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.settings.method import merged

STATIC_FINDING_DB = 22.0
VEHICLE_FINDING_DB = 18.0


@dataclass(frozen=True)
class EvaluationInputs:
    """The inputs of an evaluation: the contents of checkpoint.npz, train.json, masks.json and LPIPS's backbone.json
    (None if LPIPS is disabled), the recording, the path `truth` of a synthetic world's truth.json (None for a recorded
    drive), and the content of scans.npz (None for a method that does not render LiDAR)."""

    checkpoint: TrainedCheckpoint
    summary: dict[str, Any]
    recording: EvaluationData
    masks_record: MasksRecord
    lpips_record: dict[str, Any] | None
    truth: Path | None
    scans: ScanRecords | None = None


def read_evaluation_inputs(
    scene: str,
    parser: str,
    masks: str,
    checkpoint: str,
    summary: dict[str, Any],
    lpips: Sequence[str],
    truth: Sequence[str],
    scans: Sequence[str],
) -> tuple[EvaluationInputs, list[Provenance]]:
    """Reads the inputs of an evaluation from files, the last three where given; `summary` is the content of train.json.
    Returns them with the provenances of these files."""
    recording, upstream = read_evaluation_data(scene, parser, masks)
    trained, revolutions = read_checkpoint(checkpoint), [read_scans(path) for path in scans]
    inputs = EvaluationInputs(
        trained,
        summary,
        recording,
        read_masks_record(recording.masks),
        read_backbone(lpips[0]) if lpips else None,
        Path(truth[0]) if truth else None,
        next(iter(revolutions), None),
    )
    return inputs, [*upstream, trained.provenance, *(record.provenance for record in revolutions)]


@dataclass(frozen=True)
class SamplePair:
    """Image `index` of a recording, of held-out `group` (or 'train'): `recorded` and `rendered` (h, w, 3) in [0, 1]."""

    group: str
    index: int
    recorded: np.ndarray
    rendered: np.ndarray


@dataclass(frozen=True)
class Evaluation:
    """The content of a method's eval.json and of its eval_objects.json, without provenance, and a sample image with its
    rendering."""

    record: dict[str, Any]
    objects: dict[str, Any]
    sample: SamplePair


def evaluate_method(inputs: EvaluationInputs, job: EvaluateJob, device_settings: DeviceSettings) -> Evaluation:
    """Measures one method on the held-out images of a scene, and against truth if there is any."""
    model, device = open_model(inputs.checkpoint, device_settings)
    unavailable, lpips_map = load_lpips(inputs.lpips_record, device)
    training = inputs.recording.record
    known = known_truth(inputs, job)
    with explain_out_of_memory(lambda: len(model)):
        depths = held_out_depths(inputs.recording, job.eval_camera, job.lidar)
        measured = measure_groups(model, inputs.recording, job.eval_camera, lpips_map, device, depths, known)
        groups = {group: own.metrics for group, own in measured.items()}
        if inputs.scans is not None:
            spread = inputs.checkpoint.job.train.scans.beam_spread_rad
            lidar = lidar_metrics(model, inputs.recording.scene, inputs.scans, spread, device)
            groups = {group: {**metrics, "lidar": lidar[group]} for group, metrics in groups.items()}
        aside = side_camera_metrics(model, inputs.recording, lpips_map, device)
        against_truth = truth_metrics(model, known, inputs, job, lpips_map, device)
        sample = render_sample_pair(model, inputs.recording, job.eval_camera, device)
    header = {"schema": 1, "scene": training.scene.name, "dataset": training.scene.dataset}
    record = {
        **header,
        "protocol": protocol(training, inputs.masks_record, job),
        "drive": summarize_drive(inputs.recording, job.eval_camera, measured_images(training, job.eval_camera)),
        "result": {
            **groups,
            **({SIDE_CAMERA: aside} if aside else {}),
            **against_truth,
            "tracks": job.tracks,
            **training_figures(inputs.summary),
            "findings": findings(groups["interpolation"]),
            "shown": {"group": sample.group, "key_frame": inputs.recording.frame(sample.index).sample_index},
            **({"lpips_unavailable": unavailable} if unavailable else {}),
        },
    }
    objects = {group: own.objects for group, own in measured.items()}
    frames = {group: own.frames for group, own in measured.items()}
    return Evaluation(record, {**header, "groups": objects, "frames": frames}, sample)


def known_truth(inputs: EvaluationInputs, job: EvaluateJob) -> DriveTruth | None:
    """The truth of a synthetic world; None for a recorded drive."""
    return None if inputs.truth is None or job.removal is None else DriveTruth.read(inputs.truth, inputs.recording)


def truth_metrics(
    model: SplatModel,
    known: DriveTruth | None,
    inputs: EvaluationInputs,
    job: EvaluateJob,
    lpips_map: LpipsMap | None,
    device: torch.device,
) -> dict[str, Any]:
    """`lateral` and `removal` for a synthetic world whose truth is `known`, as far as it has truth for them, with
    `lidar` where the method renders it; empty for a recorded drive."""
    if known is None or job.removal is None:
        return {}
    truth, margin = known.truth, job.removal.margin
    lateral = lateral_metrics(model, known, job.eval_camera, lpips_map, device)
    removal = removal_metrics(model, known, job.eval_camera, margin, lpips_map, device)
    found = {"lateral": lateral or {}, "removal": removal or {}}
    if inputs.scans is not None and truth.scans:
        spread = inputs.checkpoint.job.train.scans.beam_spread_rad
        scans = ScanTruth.of(truth, known.path, inputs.recording.scene, inputs.scans, job.lidar.own_car_radius)
        found = merged(found, scan_truth_metrics(model, scans, margin, spread, device))
    return {name: figures for name, figures in found.items() if figures}


def protocol(record: TrainingRecord, masks_record: MasksRecord, job: EvaluateJob) -> dict[str, Any]:
    """The protocol of every figure, with `rate_figures` of the measured and the training images."""
    measured = [i for images in measured_images(record, job.eval_camera).values() for i in images]
    width, height = record.image_size(measured[0] if measured else 0)
    rate = record.scene.key_frame_hz
    return {
        "version": record.scene.version,
        "cameras": list(job.cameras),
        "eval_camera": job.eval_camera,
        "width": width,
        "height": height,
        "sweeps": job.sweeps,
        "holdout": holdout_figures(job.holdout, rate),
        "held_out_frames": record.held_out_frames,
        "train_images": len(record.train_images),
        "poses": record.scene.poses,
        "regions": masks_record.regions,
        "visibility": masks_record.visibility,
        "own_car": masks_record.own_car.get(job.eval_camera),
        "extra_points": record.seed.extra_points,
        "lidar_missing": record.seed.lidar_missing,
        "images_missing": record.scene.missing_images,
        "key_frame_range": record.scene.key_frame_range,
        **rate_figures(rate, record.timestamps[measured], record.timestamps[record.train_images]),
    }


def findings(group: dict[str, Any]) -> dict[str, bool | None]:
    """Whether a static model behaves as expected: findings, never gates; None if a region is null."""
    static, vehicle = ((group[region] or {}).get("psnr") for region in ("static", "vehicle"))
    return {
        "static_above_22_db": None if static is None else static > STATIC_FINDING_DB,
        "vehicle_below_18_db": None if vehicle is None else vehicle < VEHICLE_FINDING_DB,
    }


def render_sample_pair(model: SplatModel, recording: EvaluationData, camera: str, device: torch.device) -> SamplePair:
    """The held-out key frame of `camera` with the most pixels of moving vehicles, from the first group with held-out
    frames; a training key frame if nothing is held out."""
    for group in (*HELD_OUT_GROUPS, "train"):
        images = held_out_images(recording.record, group, camera)
        if images:
            break
    else:
        raise ValueError(f"no key frame of {camera} takes part")
    moving = [int(region_mask(recording.labels(index), "moving_vehicle").sum()) for index in images]
    index = images[int(np.argmax(moving))] if any(moving) else images[len(images) // 2]
    picture = rendered(model, view_of(recording.record, index, device))
    return SamplePair(group, index, recording.image(index), picture.clip(0.0, 1.0))
