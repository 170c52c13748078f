"""Metrics files as a report reads them."""

import json
from pathlib import Path
from typing import Any

from drivesplat.report.gaps import gap_report
from drivesplat.settings.report import ReportJob

PROTOCOL = {
    "version": "v1.0-mini", "cameras": ["CAM_FRONT"], "eval_camera": "CAM_FRONT", "width": 640, "height": 360,
    "sweeps": False, "holdout": {"every_nth": 8, "offset": 4, "last_block": 4},
    "held_out_frames": {"interpolation": [4], "extrapolation": [35, 36]}, "train_images": 31, "poses": "nuscenes",
    "regions": "boxes", "extra_points": None, "lidar_missing": 0,
}  # fmt: skip


def stages(methods=("vanilla",), iterations=30000, code="c") -> dict[str, Any]:
    """The stages behind a result, as provenance holds them."""
    made = {"extract": {"settings": {"sweeps": False}, "code": "e"}}
    made["parser"] = {"settings": {"images": {"width": 640}}, "code": "p"}
    for method in methods:
        made[f"{method}/train"] = {"settings": {"train": {"iterations": iterations}}, "code": code}
    return made


def region(psnr: float | None, lpips: float | None = None) -> dict[str, Any]:
    identical = {"identical": True} if psnr is None else {}
    return {"psnr": psnr, **identical, "psnr_frame_mean": psnr, "ssim": 0.8, "lpips": lpips, "pixels": 5000}


def group(
    static: float, moving: float | None = None, parked: float | None = None, lpips: float | None = None,
    people: float | None = None,
) -> dict:  # fmt: skip
    """The figures of a group: a moving and a parked vehicle, or neither, and people, or none."""
    there = [psnr for psnr in (moving, parked) if psnr is not None]
    vehicle = sum(there) / len(there) if there else None
    behind = moving if moving is not None else vehicle
    return {
        "gap_db": None if behind is None else static - behind,
        "human_gap_db": None if people is None else static - people,
        "all": region(static - 1.0, lpips),
        "static": region(static, lpips),
        "vehicle": None if vehicle is None else region(vehicle, lpips),
        "car": None,
        "moving_vehicle": None if moving is None else region(moving, lpips),
        "parked_vehicle": None if parked is None else region(parked, lpips),
        "moving_human": None if people is None else region(people, lpips),
    }


def method(interpolation: dict, extrapolation: dict, gaussians=1000, seconds=60.0) -> dict[str, Any]:
    return {
        "interpolation": interpolation, "extrapolation": extrapolation, "gaussians": gaussians,
        "train_seconds": seconds, "train_iterations": 30000, "peak_gpu_memory_gb": None, "device": "cpu",
        "random_seed": 0, "findings": {},
    }  # fmt: skip


def metrics(scene: str, methods: dict[str, dict], made=None, **protocol) -> dict[str, Any]:
    return {
        "schema": 1, "scene": scene, "dataset": "nuscenes", "protocol": {**PROTOCOL, **protocol}, "methods": methods,
        "provenance": {"stages": made or stages(tuple(methods)), "inputs": {}},
    }  # fmt: skip


NO_LOGS = Path("no such folder")


def expecting(*scenes: str, methods=("vanilla",)) -> ReportJob:
    return report_job({scene: stages(methods) for scene in scenes})


def report_job(expected: dict[str, Any]) -> ReportJob:
    return ReportJob(expected=expected, reference="vanilla", random_seed=0)


def report_of(folder: Path, *records: dict[str, Any], methods: tuple[str, ...]) -> dict[str, Any]:
    """The report of metrics files, which are written into `folder`."""
    for one in records:
        (folder / one["scene"]).mkdir(parents=True, exist_ok=True)
        (folder / one["scene"] / "metrics.json").write_text(json.dumps(one))
    scenes = [one["scene"] for one in records]
    paths = [str(folder / scene / "metrics.json") for scene in scenes]
    return gap_report(paths, expecting(*scenes, methods=methods), NO_LOGS)
