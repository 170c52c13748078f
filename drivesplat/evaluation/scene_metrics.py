"""The stage `scene_metrics`: the methods of a scene side by side in metrics.json."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from drivesplat.errors import ResultError
from drivesplat.io.storage import read_record

SCHEMA = 1


def read_evaluations(paths: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The content of every eval.json, by the name of the method, whose folder it lies in. Raises ResultError where one
    is none."""
    keys = ("scene", "dataset", "protocol", "drive", "result", "provenance")
    return {Path(path).parent.name: read_record(path, "evaluate", *keys) for path in paths}


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
