"""Results of recipes into the content of quality.json: tables of what may stand side by side, and what failed."""

from collections.abc import Sequence
from typing import Any

from benchmarks.quality.recipes import RecipeFile
from benchmarks.quality.results import Result
from drivesplat.evaluation.comparison import PSNRS, Figures, compared, figure, values_at
from drivesplat.io.storage import canonical_json

SCHEMA = 1
FIGURES: Figures = {
    **PSNRS,
    "ssim": ("all", "ssim"),
    "lpips": ("all", "lpips"),
    "depth_error": ("depth", "median_relative_error"),
}
"""What is compared in each group of held-out frames; the depth's error where it was measured."""
COSTS = ("gaussians", "train_seconds", "peak_gpu_memory_gb")
MEASURED_BY = (
    "version", "eval_camera", "width", "height", "holdout", "held_out_frames", "regions", "own_car",
    "key_frame_range",
)  # fmt: skip
"""What of the protocol figures are measured by: where it differs they do not compare. The rest is the recipe's own."""


def quality(recipes: RecipeFile, results: Sequence[Result]) -> dict[str, Any]:
    """The content of quality.json: a table for every protocol that recipes were measured by, a row for every recipe
    with at least one result, what failed, and every run with its provenance.

    `difference` of a row is to the first of its table, over the seeds that both have.
    """
    by_recipe: dict[str, list[Result]] = {name: [] for name in recipes.recipes}
    for result in results:
        by_recipe[result.recipe].append(result)
    together: dict[str, list[str]] = {}
    for name, runs in by_recipe.items():
        protocols = {canonical_json(_measured_by(run.evaluation)) for run in runs if run.evaluation}
        for protocol in protocols:
            together.setdefault(protocol, []).append(name)
    tables = [_table({name: by_recipe[name] for name in names}) for names in together.values()]
    return {
        "schema": SCHEMA,
        "scene": recipes.scene,
        "seeds": list(recipes.seeds),
        "base": list(recipes.base),
        "config": recipes.config,
        "recipes": {name: recipe.model_dump(mode="json") for name, recipe in recipes.recipes.items() if recipe},
        "tables": tables,
        "failed": [
            {"recipe": run.recipe, "seed": run.seed, "why": run.why} for run in results if run.evaluation is None
        ],
        "runs": {name: [_run(run) for run in runs] for name, runs in by_recipe.items()},
    }


def _table(of: dict[str, list[Result]]) -> dict[str, Any]:
    """The table of recipes that were measured alike."""
    first, *_ = of
    reference = [run.result for run in of[first]]
    evaluation = next(run.evaluation for run in of[first] if run.evaluation)
    return {
        "dataset": evaluation["dataset"],
        "protocol": _measured_by(evaluation),
        "reference": first,
        "rows": [_row(name, runs, None if name == first else reference) for name, runs in of.items()],
    }


def _row(recipe: str, runs: list[Result], reference: list[dict[str, Any] | None] | None) -> dict[str, Any]:
    """A recipe's figures over its seeds, beside those of the table's first (None: these are it)."""
    figures = [run.result for run in runs]
    evaluations = [run.evaluation for run in runs if run.evaluation]
    return {
        "recipe": recipe,
        "seeds": [run.seed for run in runs if run.evaluation],
        **compared(figures, reference, FIGURES),
        **{name: figure(values_at(figures, name)) for name in COSTS},
        "trained_on": {key: value for key, value in evaluations[0]["protocol"].items() if key not in MEASURED_BY},
        "train_iterations": evaluations[0]["result"]["train_iterations"],
        "devices": list(dict.fromkeys(evaluation["result"]["device"] for evaluation in evaluations)),
        "shared": any(run.shared for run in runs),
    }


def _measured_by(evaluation: dict[str, Any]) -> dict[str, Any]:
    return {key: evaluation["protocol"].get(key) for key in MEASURED_BY}


def _run(result: Result) -> dict[str, Any]:
    """A recipe with a seed, whole."""
    evaluation = result.evaluation or {}
    figures = {key: evaluation.get(key) for key in ("protocol", "result", "provenance")}
    return {"seed": result.seed, "evaluation": str(result.path), "shared": result.shared, **figures}
