"""The stage `evaluate`: held-out images against renderings, split into static and moving pixels."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from drivesplat.evaluation.depth import DepthErrors
from drivesplat.evaluation.drive_summary import drive_record
from drivesplat.evaluation.held_out import held_out_images, measured_images
from drivesplat.evaluation.lpips_map import unavailable_or_map
from drivesplat.evaluation.metrics import FrameErrors, LpipsMap, RegionMetrics, measuring_threads, with_gap
from drivesplat.evaluation.overlaps import OVERLAP_REGIONS, overlap_masks
from drivesplat.evaluation.sample_pair import Shown, held_out_pair
from drivesplat.evaluation.synthetic import KnownTruth, lateral_metrics, removal_metrics, rendered_with_depth
from drivesplat.io.prefetch import ahead
from drivesplat.lidar.depth import Depths, clouds_of, depths_in
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.readers.truth import read_truth
from drivesplat.scene.prepared_drive import Recording
from drivesplat.scene.regions import REGIONS, region_masks
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.settings.lidar_depth import LidarDepthJob

STATIC_FINDING_DB = 22.0
VEHICLE_FINDING_DB = 18.0


@dataclass(frozen=True)
class EvaluationInputs:
    """What an evaluation reads: the contents of checkpoint.pt, train.json, masks.json and LPIPS's backbone.json (None
    where LPIPS is not wanted), the recording, and the path `truth` of a synthetic world's truth.json (None for a
    recorded drive)."""

    checkpoint: dict[str, Any]
    summary: dict[str, Any]
    recording: Recording
    masks_record: dict[str, Any]
    lpips_record: dict[str, Any] | None
    truth: Path | None


@dataclass(frozen=True)
class Evaluation:
    """A method measured on a scene: the content of its eval.json, provenance aside, and the image that is `shown`."""

    record: dict[str, Any]
    shown: Shown


def evaluate_method(inputs: EvaluationInputs, job: EvaluateJob, device_settings: DeviceSettings) -> Evaluation:
    """One method on the images that it has not seen, and against the truth where there is any."""
    model, device = open_model(inputs.checkpoint, device_settings)
    unavailable, lpips_map = unavailable_or_map(inputs.lpips_record, device)
    record, summary = inputs.recording.record, inputs.summary
    with explain_out_of_memory(lambda: len(model)):
        depths = held_out_depths(inputs.recording, job.eval_camera, job.lidar)
        groups = evaluate_groups(model, inputs.recording, job.eval_camera, lpips_map, device, depths)
        against = against_truth(model, inputs, job, lpips_map, device)
        shown = held_out_pair(model, inputs.recording, job.eval_camera, device)
    record = {
        "schema": 1,
        "scene": record.scene.name,
        "dataset": record.scene.dataset,
        "protocol": protocol(record, inputs.masks_record, job),
        "drive": drive_record(inputs.recording, job.eval_camera, measured_images(record, job.eval_camera)),
        "result": {
            **groups,
            **against,
            "gaussians": summary["gaussians"],
            "train_seconds": summary["seconds"],
            "train_iterations": summary["iterations"],
            "peak_gpu_memory_gb": summary["peak_gpu_memory_gb"],
            "device": summary["device"],
            "random_seed": summary["random_seed"],
            "findings": findings(groups["interpolation"]),
            "shown": {"group": shown.group, "key_frame": inputs.recording.frame(shown.index).sample_index},
            **({"lpips_unavailable": unavailable} if unavailable else {}),
        },
    }
    return Evaluation(record, shown)


def against_truth(
    model: SplatModel, inputs: EvaluationInputs, job: EvaluateJob, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any]:
    """`lateral` and `removal`, where truth for them exists: for a synthetic world, not for a recorded drive."""
    if inputs.truth is None or job.removal is None:
        return {}
    known = KnownTruth(read_truth(inputs.truth), inputs.truth, inputs.recording)
    lateral = lateral_metrics(model, known, job.eval_camera, lpips_map, device)
    removal = removal_metrics(model, known, job.eval_camera, job.removal.margin, lpips_map, device)
    return {**({"lateral": lateral} if lateral else {}), **({"removal": removal} if removal else {})}


def protocol(record: TrainingRecord, masks_record: dict[str, Any], job: EvaluateJob) -> dict[str, Any]:
    """What every figure must be read with."""
    measured = [i for images in measured_images(record, job.eval_camera).values() for i in images]
    width, height = record.image_size(measured[0] if measured else 0)
    return {
        "version": record.scene.version,
        "cameras": list(job.cameras),
        "eval_camera": job.eval_camera,
        "width": width,
        "height": height,
        "sweeps": job.sweeps,
        "holdout": job.holdout.model_dump(),
        "held_out_frames": record.held_out_frames,
        "train_images": len(record.train_images),
        "poses": record.scene.poses,
        "regions": masks_record["regions"],
        "own_car": masks_record["own_car"].get(job.eval_camera),
        "extra_points": record.seed.extra_points,
        "lidar_missing": record.seed.lidar_missing,
        "images_missing": record.scene.missing_images,
        "key_frame_range": record.scene.key_frame_range,
    }


def findings(group: dict[str, Any]) -> dict[str, bool | None]:
    """Whether the scene shows what is expected of a static model. Never a gate; None where a region is null."""

    def of(region: str) -> float | None:
        return group[region]["psnr"] if group[region] else None

    static, vehicle = of("static"), of("vehicle")
    return {
        "static_above_22_db": None if static is None else static > STATIC_FINDING_DB,
        "vehicle_below_18_db": None if vehicle is None else vehicle < VEHICLE_FINDING_DB,
    }


def held_out_depths(recording: Recording, camera: str, job: LidarDepthJob) -> dict[int, Depths]:
    """What LiDAR says of the images that are measured, by their numbers: each by the sweep of its own key frame; those
    whose sweep is missing are left out."""
    scene = recording.scene
    clouds = {cloud.sample_index: cloud for cloud in clouds_of(scene, job, HELD_OUT_GROUPS)}
    images = [i for group in HELD_OUT_GROUPS for i in held_out_images(recording.record, group, camera)]
    owned = {i: clouds[scene.frames[i].sample_index] for i in images if scene.frames[i].sample_index in clouds}
    return {i: depths_in(scene, scene.frames[i], cloud, job, recording.own_car(i)) for i, cloud in owned.items()}


def evaluate_groups(
    model: SplatModel,
    recording: Recording,
    camera: str,
    lpips_map: LpipsMap | None,
    device: torch.device,
    depths: Mapping[int, Depths] = MappingProxyType({}),
) -> dict[str, dict[str, Any]]:
    """The metrics of every held-out group, by region; `depth` where LiDAR tells the `depths` of held-out images, by
    their numbers; with several cameras `overlap` and `no_overlap`, the static pixels where others look, too, and where
    none does."""
    of_group = partial(_group, model, recording, lpips_map, device, depths)
    return {group: of_group(images) for group, images in measured_images(recording.record, camera).items()}


def _group(
    model: SplatModel,
    recording: Recording,
    lpips_map: LpipsMap | None,
    device: torch.device,
    depths: Mapping[int, Depths],
    images: list[int],
) -> dict[str, Any]:
    """The metrics of a held-out group of `images`."""
    record = recording.record
    rig = len(record.camera_names) > 1
    metrics, depth = RegionMetrics(lpips_map, (*REGIONS, *(OVERLAP_REGIONS if rig else ()))), DepthErrors()

    def shown() -> Iterator[tuple[int, np.ndarray]]:
        for index in images:
            image, metres = rendered_with_depth(model, view_of(record, index, device))
            if index in depths:
                depth.add(metres, depths[index])
            yield index, image

    def measured(one: tuple[int, np.ndarray]) -> dict[str, FrameErrors]:
        index, image = one
        masks = region_masks(recording.labels(index))
        if rig:
            masks |= overlap_masks(record, index, masks["static"])
        return metrics.measured(image, recording.image(index), masks)

    for frame in ahead(measured, shown(), measuring_threads()):
        metrics.add(frame)
    return {**with_gap(metrics.summary()), **depth.summary()}
