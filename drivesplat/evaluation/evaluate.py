"""The stage `evaluate`: held-out images against renderings, split into static and moving pixels."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.device import choose_device, telling_out_of_memory
from drivesplat.errors import DatasetError
from drivesplat.evaluation.lpips_map import unavailable_or_map
from drivesplat.evaluation.metrics import LpipsMap, RegionMetrics
from drivesplat.holdout import HELD_OUT_GROUPS
from drivesplat.images import read_image
from drivesplat.masks import read_labels
from drivesplat.model.splat_model import SplatModel
from drivesplat.parser import image_size
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.training.run import trained_model
from drivesplat.training.views import view_of

STATIC_FINDING_DB = 22.0
VEHICLE_FINDING_DB = 18.0


def evaluate_method(
    checkpoint: dict[str, Any],
    summary: dict[str, Any],
    parser: dict[str, Any],
    masks: Path,
    masks_record: dict[str, Any],
    lpips_record: dict[str, Any] | None,
    job: EvaluateJob,
    device_settings: DeviceSettings,
) -> dict[str, Any]:
    """The content of one method's eval.json, provenance aside.

    `checkpoint`, `summary` and `parser` are the contents of checkpoint.pt, train.json and parser.pkl; `lpips_record`
    that of LPIPS's backbone, None where LPIPS is not wanted.
    """
    device = choose_device(device_settings, min_free_gb=0.0)
    model, train_job = trained_model(checkpoint)
    unavailable, lpips_map = unavailable_or_map(lpips_record, device)
    sh_degree = train_job.train.gaussians.sh_degree
    with telling_out_of_memory(lambda: len(model)):
        groups = evaluate_groups(model.to(device), parser, masks, job.eval_camera, sh_degree, lpips_map, device)
    return {
        "schema": 1,
        "scene": parser["scene"]["name"],
        "dataset": parser["scene"]["dataset"],
        "protocol": protocol(parser, masks_record, job),
        "result": {
            **groups,
            "gaussians": summary["gaussians"],
            "train_seconds": summary["seconds"],
            "train_iterations": summary["iterations"],
            "peak_gpu_memory_gb": summary["peak_gpu_memory_gb"],
            "device": summary["device"],
            "random_seed": summary["random_seed"],
            "findings": findings(groups["interpolation"]),
            **({"lpips_unavailable": unavailable} if unavailable else {}),
        },
    }


def protocol(parser: dict[str, Any], masks_record: dict[str, Any], job: EvaluateJob) -> dict[str, Any]:
    """What every figure must be read with."""
    measured = [i for group in HELD_OUT_GROUPS for i in held_out_images(parser, group, job.eval_camera)]
    width, height = image_size(parser, measured[0] if measured else 0)
    return {
        "version": parser["scene"]["version"],
        "cameras": list(job.cameras),
        "eval_camera": job.eval_camera,
        "width": width,
        "height": height,
        "sweeps": job.sweeps,
        "holdout": job.holdout.model_dump(),
        "held_out_frames": parser["held_out_frames"],
        "train_images": len(parser["splits"]["train"]),
        "poses": parser["scene"]["poses"],
        "regions": masks_record["regions"],
        "extra_points": parser["seed"]["extra_points"],
        "lidar_missing": parser["seed"]["lidar_missing"],
        "images_missing": parser["scene"]["missing_images"],
        "key_frame_range": parser["scene"]["key_frame_range"],
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


def held_out_images(parser: dict[str, Any], group: str, camera: str) -> list[int]:
    """The images of `group` that are measured: key frames of the evaluated camera.

    Raises DatasetError where the scene does not hold that camera.
    """
    if camera not in parser["camera_names"]:
        raise DatasetError(
            f"eval_camera {camera} is not among the cameras of this run ({', '.join(parser['camera_names'])})"
        )
    wanted = parser["camera_names"].index(camera)
    return [
        int(i) for i in parser["splits"][group] if parser["camera_indices"][i] == wanted and parser["is_key_frame"][i]
    ]


def evaluate_groups(
    model: SplatModel, parser: dict[str, Any], masks: Path, camera: str, sh_degree: int, lpips_map: LpipsMap | None,
    device: torch.device
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """The metrics of every held-out group, by region. `masks` is the folder of the stage `masks`."""
    groups = {}
    for group in HELD_OUT_GROUPS:
        metrics = RegionMetrics(lpips_map)
        for index in held_out_images(parser, group, camera):
            size = image_size(parser, index)
            truth = read_image(parser["image_paths"][index], size) / 255.0
            labels = read_labels(masks, camera, int(parser["timestamps"][index]), size)
            metrics.add(render(model, parser, index, sh_degree, device), truth, labels)
        groups[group] = metrics.summary()
    return groups


@torch.no_grad()
def render(model: SplatModel, parser: dict[str, Any], index: int, sh_degree: int, device: torch.device) -> np.ndarray:
    """Image `index` of a parser record as the model renders it: (h, w, 3) float32, not clamped."""
    return model.render(view_of(parser, index, device), sh_degree).image.float().cpu().numpy()
