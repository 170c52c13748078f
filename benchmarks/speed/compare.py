"""Timed trainings into the content of speed.json: time and quality of both recipes for every length."""

from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.speed.plan import RECIPES
from benchmarks.speed.settings import SpeedFile
from drivesplat.evaluation.comparison import Figures, compare_runs, summarize

SCHEMA = 1
FIGURES: Figures = {
    "static": ("static", "psnr"),
    "all": ("all", "psnr"),
    "moving_vehicle": ("moving_vehicle", "psnr"),
    "ssim": ("all", "ssim"),
}
COSTS = ("loop", "whole", "gaussians", "peak_gpu_memory_gb")
TIMES = ("loop", "whole")
Record = dict[str, Any]


def speed(file: SpeedFile, runs: Sequence[Record], profiles: Sequence[Record]) -> Record:
    """The content of speed.json: a table for every length for which both recipes have run with some seed, and the
    complete record of every run."""
    tables = [_table(file, iterations, runs, profiles) for iterations in file.iterations]
    return {
        "schema": SCHEMA,
        **file.model_dump(mode="json"),
        "tables": [table for table in tables if table is not None],
        "runs": list(runs),
    }


def _table(file: SpeedFile, iterations: int, runs: Sequence[Record], profiles: Sequence[Record]) -> Record | None:
    """Both recipes at one length, over the seeds that both have; None if there is none."""
    by_key = {(run["recipe"], run["seed"]): run for run in runs if run["iterations"] == iterations}
    seeds = [seed for seed in file.seeds if all((recipe, seed) in by_key for recipe in RECIPES)]
    if not seeds:
        return None
    by_recipe = {recipe: [by_key[recipe, seed] for seed in seeds] for recipe in RECIPES}
    every = [run for of_recipe in by_recipe.values() for run in of_recipe]
    return {
        "iterations": iterations,
        "seeds": seeds,
        "protocol": every[0]["protocol"],
        "dataset": every[0]["dataset"],
        "cap_max": every[0]["cap_max"],
        "devices": list(dict.fromkeys(run["device"] for run in every)),
        "processors": max(run["processors"] for run in every),
        "busy_elsewhere": max(run["busy_elsewhere"] or 0.0 for run in every),
        "ssim_of_plain": by_recipe["plain"][0]["ssim"],
        "rows": [_row(recipe, by_recipe[recipe], by_recipe["plain"]) for recipe in RECIPES],
        "times_as_fast": {name: _times_as_fast(name, by_recipe["plain"], by_recipe["ours"]) for name in TIMES},
        "stages": {p["recipe"]: p["stages"] for p in profiles if p["iterations"] == iterations},
    }


def _row(recipe: str, runs: Sequence[Record], plain: Sequence[Record]) -> Record:
    """A recipe's costs and figures over its seeds, compared with the plain recipe."""
    reference = None if recipe == "plain" else [run["result"] for run in plain]
    return {
        "recipe": recipe,
        **{name: summarize([run[name] for run in runs]) for name in COSTS},
        "iterations_per_second": summarize([run["iterations"] / run["loop"] for run in runs]),
        **compare_runs([run["result"] for run in runs], reference, FIGURES),
    }


def _times_as_fast(name: str, plain: Iterable[Record], ours: Iterable[Record]) -> Record | None:
    """The speed-up of ours over the plain recipe, paired by seed."""
    return summarize([slow[name] / fast[name] for slow, fast in zip(plain, ours, strict=True)])
