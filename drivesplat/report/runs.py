"""Runs in the closed loop in the report: a row for each episode, and the table of the page."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drivesplat.io.storage import read_json, unreadable

RUN_FIGURES = (
    {"key": "pdms", "title": "PDM score ↑", "form": "{:.2f}", "kind": "first"},
    {"key": "hd_score", "title": "HD score ↑", "form": "{:.2f}", "kind": ""},
    {"key": "alpasim_score", "title": "AlpaSim ↑", "form": "{:.2f}", "kind": ""},
    {"key": "progress_ratio", "title": "progress", "form": "{:.0%}", "kind": "first"},
    {"key": "duration_s", "title": "seconds", "form": "{:.1f}", "kind": ""},
    {"key": "believable_s", "title": "believable, s", "form": "{:.1f}", "kind": ""},
)
"""The columns of the table: key of the figure, title, format and CSS class."""


def run_rows(paths: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of the records `{scene}/{method}/runs/{run}.json`, one for each episode. Raises ResultError for a file
    that is none."""
    rows = []
    for path in paths:
        record = read_json(path, "run")
        *_, scene, method, _, name = Path(path).parts
        place = {"scene": scene, "method": method, "run": Path(name).stem}
        try:
            place["policy"] = record["run"]["policy"]
            rows += [{**place, **_episode(episode)} for episode in record["episodes"]]
            if not record["episodes"]:
                rows.append({**place, "seed": None, "what": record["failed"], "failed": True, **_figures({})})
        except (AttributeError, KeyError, TypeError) as error:
            raise unreadable(path, "run", f"not the record of a run ({error})") from error
    return rows


def _episode(episode: dict[str, Any]) -> dict[str, Any]:
    """Of one episode: what happened in words, and its figures."""
    failed, scores = episode["failed"], episode["scores"]
    incident = scores.get("first_incident")
    what = failed or episode["ended"]
    if not failed and incident:
        blame = ", at fault" if incident.get("at_fault") else ""
        what = f"{incident['kind'].replace('_', ' ')} at {incident['second']:.1f} s{blame}"
    figures = _figures({**scores, "believable_s": episode.get("believable_s")})
    return {"seed": episode["seed"], "what": what, "failed": bool(failed), **figures}


def _figures(scores: dict[str, Any]) -> dict[str, Any]:
    return {column["key"]: scores.get(column["key"]) for column in RUN_FIGURES}


def run_table(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The table of the page: its `columns` and `rows`."""
    return {"columns": RUN_FIGURES, "rows": list(rows)}
