"""Hand-made results of recipes: eval.json files with given figures, and logs of failed jobs."""

import json
import re
from pathlib import Path
from typing import Any

import yaml

from benchmarks.quality.recipes import RecipeFile, plan_runs, read_recipes
from benchmarks.snakemake_run import SnakemakeRun
from drivesplat.settings.method import with_seed
from helpers import REPOSITORY, reports

PROTOCOL = reports.PROTOCOL | {
    "held_out_frames": {"interpolation": [4, 12, 20, 28], "extrapolation": [35, 36, 37, 38]}, "lidar_missing": 38,
    "images_missing": 0, "key_frame_range": None, "own_car": None,
}  # fmt: skip


def recipe_file(folder: Path, **content: Any) -> tuple[RecipeFile, list[SnakemakeRun]]:
    """Recipes on scene 0061 with seeds 0 and 1, written and read, and their runs with results in `folder`."""
    path = folder / "recipes.yaml"
    path.write_text(yaml.safe_dump({"scene": "0061", "seeds": [0, 1], **content}, sort_keys=False))
    recipes = read_recipes(path)
    return recipes, plan_runs(recipes, folder / "out", REPOSITORY)


def evaluation(
    static: float | None, moving: float | None = None, ssim: float = 0.5, protocol: dict | None = None, **result: Any
) -> dict[str, Any]:
    """An eval.json with such figures between training frames, and static ones 5 dB lower beyond them."""
    between = {
        "gap_db": None if static is None or moving is None else static - moving,
        "static": None if static is None else {"psnr": static},
        "moving_vehicle": None if moving is None else {"psnr": moving},
        "all": {"psnr": static, "ssim": ssim, "lpips": None},
    }
    beyond = {"gap_db": None, "static": static and {"psnr": static - 5.0}, "moving_vehicle": None, "all": None}
    costs = {
        "gaussians": 1000, "train_seconds": 60.0, "train_iterations": 15000, "peak_gpu_memory_gb": 2.5,
        "device": "NVIDIA H200",
    }  # fmt: skip
    return {
        "scene": "0061", "dataset": "nuscenes", "protocol": {**PROTOCOL, **(protocol or {})},
        "result": {"interpolation": between, "extrapolation": beyond, **costs, **result},
    }  # fmt: skip


def write_evaluation(run: SnakemakeRun, recipe: str, seed: int, content: dict[str, Any]) -> Path:
    """Writes an eval.json to its place, with the provenance that the run's plan expects."""
    path = run.evaluation(recipe, seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    stages = run.plan.evaluation_stages(run.scene, [with_seed(recipe, seed)])
    path.write_text(json.dumps({**content, "provenance": {"stages": stages}}))
    return path


def write_failure(path: Path, job: str, reason: str, level: str = "ERROR") -> Path:
    """Writes the log of a job, named by stage and scene, that failed for a reason."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f"2026-11-21 20:30:20,123 INFO drivesplat.workflow.job: {job} begins\n"
        f"2026-11-21 20:31:20,123 {level} drivesplat.workflow.job: {job}: {reason}\n"
    )
    return path


def table_cells(page: str) -> list[list[list[str]]]:
    """The Markdown tables of a page: lines of cells."""
    blocks = [block.splitlines() for block in page.split("\n\n") if block.startswith("|")]
    return [[[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in block] for block in blocks]
