"""The stage `scene_metrics`: all methods of a scene in one metrics.json."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from drivesplat.errors import ResultError
from drivesplat.io.storage import read_record

SCHEMA = 1


def read_evaluations(paths: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The content of every eval.json, by the name of its folder, the method. Raises ResultError if one is invalid."""
    keys = ("scene", "dataset", "protocol", "drive", "result", "provenance")
    return {Path(path).parent.name: read_record(path, "evaluate", *keys) for path in paths}


def read_baselines(path: str) -> dict[str, Any]:
    """The content of a scan_baselines.json. Raises ResultError if it is invalid."""
    return read_record(path, "scan_baselines", "baselines", "provenance")


def side_by_side(
    evals: dict[str, dict[str, Any]],
    baselines: dict[str, Any] | None = None,
    tracks_quality: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The content of metrics.json, without provenance, from the eval.json of every method by name and, where methods
    render LiDAR, the content of scan_baselines.json; `tracks_quality` is that of the discovered tracks, where methods
    train with them and there are annotated ones.

    Raises ResultError if two methods were measured under different protocols: their figures do not compare.
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
        **({"lidar_baselines": baselines["baselines"]} if baselines else {}),
        **({"tracks_quality": tracks_quality} if tracks_quality else {}),
    }
