"""Timed trainings into the content of speed.json: time and quality of all recipes for every length."""

from collections.abc import Sequence
from typing import Any

from benchmarks.speed.curves import NEAR_DB, best_of, seconds_until
from benchmarks.speed.settings import SpeedFile
from drivesplat.evaluation.comparison import Figures, compare_runs, summarize

SCHEMA = 2
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
    """The content of speed.json: a table for every length for which all recipes have run with some seed, and the
    complete record of every run."""
    tables = [_table(file, iterations, runs, profiles) for iterations in file.iterations]
    return {
        "schema": SCHEMA,
        **file.model_dump(mode="json"),
        "tables": [table for table in tables if table is not None],
        "runs": list(runs),
    }


def _table(file: SpeedFile, iterations: int, runs: Sequence[Record], profiles: Sequence[Record]) -> Record | None:
    """All recipes at one length, over the seeds that all have; None if there is none."""
    by_key = {(run["recipe"], run["seed"]): run for run in runs if run["iterations"] == iterations}
    seeds = [seed for seed in file.seeds if all((recipe, seed) in by_key for recipe in file.recipes)]
    if not seeds:
        return None
    by_recipe = {recipe: [by_key[recipe, seed] for seed in seeds] for recipe in file.recipes}
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
        "rows": [_row(recipe, by_recipe[recipe], by_recipe["plain"]) for recipe in file.recipes],
        "stages": {p["recipe"]: p["stages"] for p in profiles if p["iterations"] == iterations},
    }


def _row(recipe: str, runs: Sequence[Record], plain: Sequence[Record]) -> Record:
    """A recipe's costs and figures over its seeds, compared with the plain recipe."""
    reference = None if recipe == "plain" else [run["result"] for run in plain]
    return {
        "recipe": recipe,
        **{name: summarize([run[name] for run in runs]) for name in COSTS},
        "iterations_per_second": summarize([run["iterations"] / run["loop"] for run in runs]),
        "times_as_fast": {name: _times_as_fast(name, plain, runs) for name in TIMES} if reference else None,
        "time_to_quality": _time_to_quality(runs, plain),
        **compare_runs([run["result"] for run in runs], reference, FIGURES),
    }


def _times_as_fast(name: str, plain: Sequence[Record], others: Sequence[Record]) -> Record | None:
    """The speed-up over the plain recipe, paired by seed."""
    return summarize([slow[name] / fast[name] for slow, fast in zip(plain, others, strict=True)])


def _time_to_quality(runs: Sequence[Record], plain: Sequence[Record]) -> Record:
    """The best static PSNR of a recipe's trainings; the seconds until they are within NEAR_DB of it; and the seconds
    until they reach the best of the plain recipe with the same seed. None where one of them does not."""
    best = [best_of(run["curve"]) for run in runs]
    near = [seconds_until(run["curve"], of and of - NEAR_DB) for run, of in zip(runs, best, strict=True)]
    as_plain = [seconds_until(run["curve"], best_of(other["curve"])) for run, other in zip(runs, plain, strict=True)]
    found = {"best": best, "near_best": near, "best_of_plain": as_plain}
    return {name: None if None in values else summarize(values) for name, values in found.items()}
