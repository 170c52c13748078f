"""Results of recipes into the content of quality.json: a table for each protocol, and the failures."""

from collections.abc import Sequence
from typing import Any

from benchmarks.quality.recipes import RecipeFile
from benchmarks.quality.results import Result
from benchmarks.quality.truth import truth_figures
from drivesplat.evaluation.comparison import PSNRS, Figures, compare_runs, summarize, values_at
from drivesplat.io.storage import canonical_json

SCHEMA = 1
FIGURES: Figures = {
    **PSNRS,
    "moving_human": ("moving_human", "psnr"),
    "ssim": ("all", "ssim"),
    "lpips": ("all", "lpips"),
    "depth_error": ("depth", "median_relative_error"),
}
"""The figures of each group of held-out frames."""
COSTS = ("gaussians", "train_seconds", "peak_gpu_memory_gb")
MEASURING_PROTOCOL = (
    "version", "eval_camera", "width", "height", "holdout", "held_out_frames", "regions", "own_car",
    "key_frame_range",
)  # fmt: skip
"""The part of the protocol that must be equal for figures to compare. The rest describes the recipe."""


def quality(file: RecipeFile, results: Sequence[Result]) -> dict[str, Any]:
    """The content of quality.json: a table for every protocol with a row for every recipe that has a result, the
    failures, and every run with its provenance.

    The `difference` of a row is from the first row of its table, over the seeds that both have.
    """
    by_recipe: dict[str, list[Result]] = {name: [] for name in file.recipes}
    for result in results:
        by_recipe[result.recipe].append(result)
    recipes_of: dict[str, list[str]] = {}
    for name, runs in by_recipe.items():
        protocols = {canonical_json(_measuring_protocol(run.evaluation)) for run in runs if run.evaluation}
        for protocol in protocols:
            recipes_of.setdefault(protocol, []).append(name)
    return {
        "schema": SCHEMA,
        "scene": file.scene,
        "seeds": list(file.seeds),
        "base": list(file.base),
        "config": file.config,
        "recipes": {name: recipe.model_dump(mode="json") for name, recipe in file.recipes.items() if recipe},
        "tables": [_table({name: by_recipe[name] for name in names}) for names in recipes_of.values()],
        "failed": [
            {"recipe": run.recipe, "seed": run.seed, "why": run.reason} for run in results if run.evaluation is None
        ],
        "runs": {name: [_run(run) for run in runs] for name, runs in by_recipe.items()},
    }


def _table(by_recipe: dict[str, list[Result]]) -> dict[str, Any]:
    """The table of recipes that were measured under one protocol."""
    first, *_ = by_recipe
    reference = [run.figures for run in by_recipe[first]]
    evaluation = next(run.evaluation for run in by_recipe[first] if run.evaluation)
    return {
        "dataset": evaluation["dataset"],
        "protocol": _measuring_protocol(evaluation),
        "reference": first,
        "rows": [_row(name, runs, None if name == first else reference) for name, runs in by_recipe.items()],
    }


def _row(recipe: str, runs: list[Result], reference: list[dict[str, Any] | None] | None) -> dict[str, Any]:
    """A recipe's figures over its seeds, compared with those of the reference (None for the reference itself)."""
    figures = [run.figures for run in runs]
    evaluations = [run.evaluation for run in runs if run.evaluation]
    return {
        "recipe": recipe,
        "seeds": [run.seed for run in runs if run.evaluation],
        **compare_runs(figures, reference, FIGURES),
        "truth": truth_figures(figures),
        **{name: summarize(values_at(figures, name)) for name in COSTS},
        "trained_on": {k: value for k, value in evaluations[0]["protocol"].items() if k not in MEASURING_PROTOCOL},
        "train_iterations": evaluations[0]["result"]["train_iterations"],
        "devices": list(dict.fromkeys(evaluation["result"]["device"] for evaluation in evaluations)),
        "shared": any(run.shared for run in runs),
    }


def _measuring_protocol(evaluation: dict[str, Any]) -> dict[str, Any]:
    return {key: evaluation["protocol"].get(key) for key in MEASURING_PROTOCOL}


def _run(result: Result) -> dict[str, Any]:
    """The complete record of a recipe with a seed."""
    evaluation = result.evaluation or {}
    content = {key: evaluation.get(key) for key in ("protocol", "result", "provenance")}
    return {"seed": result.seed, "evaluation": str(result.path), "shared": result.shared, **content}
