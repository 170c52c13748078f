"""The stage `scene_metrics`: the methods of a scene side by side in metrics.json."""

from typing import Any

from drivesplat.errors import ResultError

SCHEMA = 1


def side_by_side(evals: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The content of metrics.json from the eval.json of every method, by name, provenance aside.

    Raises ResultError where two methods were measured under different protocols: their figures cannot stand together.
    """
    (first_name, first), *others = evals.items()
    for name, record in others:
        for key in ("scene", "dataset", "protocol"):
            if record[key] != first[key]:
                raise ResultError(
                    f"scene {first['scene']}: {first_name} and {name} were measured differently ({key}); "
                    "delete the older eval.json and rerun"
                )
    return {
        "schema": SCHEMA,
        "scene": first["scene"],
        "dataset": first["dataset"],
        "protocol": first["protocol"],
        "drive": first["drive"],
        "methods": {name: record["result"] for name, record in evals.items()},
    }
