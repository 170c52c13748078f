"""The PSNR gap between static and moving pixels per scene and method, and its means over scenes.

Means of gaps and the share of a gap that a method closes are over scenes with moving vehicles; in other scenes `gap_db`
is that of parked vehicles, which no method has to close.
"""

import json
import math
from pathlib import Path
from typing import Any

from drivesplat.errors import ResultError
from drivesplat.evaluation.comparison import GROUP_PLACES
from drivesplat.io.storage import read_json, unreadable
from drivesplat.provenance.file_digests import checked_digest
from drivesplat.provenance.record import differences
from drivesplat.report.aside import aside_report, aside_rows
from drivesplat.report.lidar import lidar_report, lidar_rows
from drivesplat.report.published import Measured, beside_published, measured_figures
from drivesplat.report.statistics import PairedPsnr, gap_closed, mean_over_scenes
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.settings.report import ReportJob
from drivesplat.workflow.job_logs import why_missing

SCHEMA = 3
REGIONS = ("moving_vehicle", "static", "vehicle")
HUMANS = ("moving_human", "human_gap_db")
"""The PSNR of moving people, and the gap between static pixels and theirs."""
WHOLE_IMAGE = ("psnr", "psnr_frame_mean", "ssim", "lpips")
"""The metrics of all pixels of an image."""


def gap_report(paths: list[str], job: ReportJob, logs: Path) -> dict[str, Any]:
    """The content of gap_report.json from the metrics.json files of measured scenes.

    Results of other settings or code than `job` expects, or of another protocol than the first, are listed under
    `left_out`. `missing` lists the configured scenes without a result, with the reason from the jobs' `logs`.
    `partial`: whether either is not empty. `aside` is that of `aside_report`, `lidar` that of `lidar_report`;
    `published` has published figures beside those of the same scenes.
    """
    rows: list[dict[str, Any]] = []
    scans: list[dict[str, Any]] = []
    aside: list[dict[str, Any]] = []
    left_out: list[dict[str, str]] = []
    measured: dict[str, Any] = {}
    protocols: dict[str, Any] = {}
    figures: dict[str, Measured] = {}
    for path in paths:
        scene = Path(path).parent.name
        try:
            record = read_json(path, rule="scene_metrics")
            checked_digest(path, warn=False)
            reasons = _mismatches(record, job.expected, measured)
            scene_rows, scene_scans, scene_aside = _rows(record), lidar_rows(record), aside_rows(record)
            scene_figures = measured_figures(record, job.published)
            scene = record["scene"]
        except ResultError as error:
            reasons = [str(error)]
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            why = f"not the metrics of a scene ({type(error).__name__}: {error})"
            reasons = [str(unreadable(path, "scene_metrics", why))]
        if reasons:
            left_out.append({"scene": scene, "why": "; ".join(reasons)})
            continue
        measured[scene], protocols[scene] = _comparable(record), record["protocol"]
        figures[scene] = scene_figures
        rows += scene_rows
        scans += scene_scans
        aside += scene_aside
    named = {*measured, *(item["scene"] for item in left_out)}
    missing = [{"scene": scene, "why": why_missing(logs, scene)} for scene in job.expected if scene not in named]
    return {
        "schema": SCHEMA,
        "partial": bool(missing or left_out),
        "reference": job.reference,
        "rows": rows,
        "means": _means(rows, job.random_seed),
        "gap_closed": _gaps_closed(rows, job.reference, job.random_seed),
        "aside": aside_report(aside, job.random_seed),
        "lidar": lidar_report(scans, job.random_seed),
        "left_out": left_out,
        "missing": missing,
        "protocols": protocols,
        "published": beside_published(job.published, figures),
    }


NAMES = ("scene", "dataset", "method", "tracks")
NOTES = {"annotated": "", "discovered": " (discovered tracks)", "none": " (no tracks)"}
"""What sentences say of the tracks that a method trains with."""
FIGURES = (
    *(f"{group}_{name}" for group in HELD_OUT_GROUPS for name in (*REGIONS, "gap_db", *HUMANS, *WHOLE_IMAGE)),
    "gaussians", "train_seconds",
)  # fmt: skip
COLUMNS = (*NAMES, *FIGURES)


def _mismatches(record: dict[str, Any], expected: dict[str, Any], measured: dict[str, Any]) -> list[str]:
    scene = record["scene"]
    if scene not in expected:
        return ["not in the config"]
    reasons = differences(expected[scene], record["provenance"]["stages"])
    own = _comparable(record)
    alike = (scene for scene, entries in measured.items() if bool(entries["cameras"]) == bool(own["cameras"]))
    other = next(alike, None)
    unlike = [key for key in _COMPARABLE if other is not None and measured[other][key] != own[key]]
    if unlike:
        reasons.append(f"its protocol differs from that of scene {other}: {', '.join(unlike)}")
    return reasons


_COMPARABLE = ("cameras", "eval_camera", "width", "height", "sweeps", "holdout", "poses", "regions")


def _comparable(record: dict[str, Any]) -> dict[str, Any]:
    """The entries of a protocol that must be equal for figures to be comparable; scenes without cameras have figures of
    LiDAR alone and are compared among each other. A scene that kept its poses because
    refinement was rejected (see `protocol.poses`) is comparable with refined ones, one with poses from images not."""
    own = {key: record["protocol"][key] for key in _COMPARABLE}
    refined = "refine_poses" in record["provenance"]["stages"] and own["poses"] != "images"
    return own | ({"poses": "refined"} if refined else {})


def _rows(record: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of all methods of a scene. Raises ValueError where there is none, or a figure is no finite number."""
    rows = [_row(record, method) for method in record["methods"]]
    if not rows:
        raise ValueError("it has no method")
    for row in rows:
        for column in FIGURES:
            value = row[column]
            if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
                raise ValueError(f"{column} of {row['method']} is {value!r}, not a number")
        if row["tracks"] not in NOTES:
            raise ValueError(f"the tracks of {row['method']} are {row['tracks']!r}")
        if row["shown"] is not None and row["shown"]["group"] not in (*GROUP_PLACES, "train"):
            raise ValueError(f"the image shown of {row['method']} is of no group")
    json.dumps(record, allow_nan=False)  # what the report repeats of it holds no NaN either
    return rows


def _row(record: dict[str, Any], method: str) -> dict[str, Any]:
    result = record["methods"][method]
    row = {"scene": record["scene"], "dataset": record["dataset"], "method": method}
    row["tracks"] = result.get("tracks", "annotated")
    for group in HELD_OUT_GROUPS:
        for region in (*REGIONS, HUMANS[0]):
            row[f"{group}_{region}"] = (result[group].get(region) or {}).get("psnr")
        row |= {f"{group}_{gap}": result[group].get(gap) for gap in ("gap_db", HUMANS[1])}
        whole = result[group]["all"] or dict.fromkeys(WHOLE_IMAGE)
        row |= {f"{group}_{name}": whole[name] for name in WHOLE_IMAGE}
    costs = {"gaussians": result["gaussians"], "train_seconds": result["train_seconds"]}
    return {**row, **costs, "shown": result.get("shown")}


def _means(rows: list[dict[str, Any]], random_seed: int) -> list[dict[str, Any]]:
    """The means of every figure over scenes, by method; null figures are ignored."""
    return [
        {
            "method": method,
            "tracks": next(iter(own.values()))["tracks"],
            "figures": {
                column: mean_over_scenes([_figure(row, column) for row in own.values()], random_seed)
                for column in FIGURES
            },
        }
        for method, own in _by_method(rows).items()
    ]


def _gaps_closed(rows: list[dict[str, Any]], reference: str | None, random_seed: int) -> list[dict[str, Any]]:
    """The share of the reference's gap that every other method closes (`gap_closed`), by group of held-out frames."""
    methods = _by_method(rows)
    given = methods.pop(reference, {}) if reference else {}
    found = []
    for method, own in methods.items():
        both = [(given[scene], row) for scene, row in own.items() if scene in given]
        closed = {}
        for group in HELD_OUT_GROUPS:
            figures = ([row[f"{group}_{name}"] for row in pair for name in REGIONS[:2]] for pair in both)
            closed[group] = gap_closed([PairedPsnr(*known) for known in figures if None not in known], random_seed)
        if any(closed.values()):
            found.append({"method": method, **closed})
    return found


def _by_method(rows: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    """The rows by method, then by scene, in the order of the rows."""
    methods: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows:
        methods.setdefault(row["method"], {})[row["scene"]] = row
    return methods


def moving_gap(row: dict[str, Any], group: str) -> float | None:
    """The gap of a row to moving vehicles; None without them."""
    return None if row[f"{group}_moving_vehicle"] is None else row[f"{group}_gap_db"]


def _figure(row: dict[str, Any], column: str) -> int | float | None:
    """The figure of a row that enters a mean."""
    group, _, name = column.partition("_")
    return moving_gap(row, group) if name == "gap_db" else row[column]


def shows_other_tracks(report: dict[str, Any]) -> bool:
    """Whether a method of a report trains with other tracks than the annotated ones."""
    return any(row["tracks"] != "annotated" for row in report["rows"])


def shows_people(report: dict[str, Any]) -> bool:
    """Whether a scene of a report has moving people in held-out frames."""
    return any(
        row[f"{group}_{name}"] is not None for row in report["rows"] for group in HELD_OUT_GROUPS for name in HUMANS
    )


def summary_sentences(report: dict[str, Any]) -> list[str]:
    """A sentence per method and group of held-out frames with moving vehicles: their PSNR, the gap to static pixels,
    and both compared with the reference."""
    lines = []
    closed = {item["method"]: item for item in report["gap_closed"]}
    for mean in report["means"]:
        for group in HELD_OUT_GROUPS:
            moving, gap = (mean["figures"][f"{group}_{name}"] for name in ("moving_vehicle", "gap_db"))
            if moving is None or gap is None:
                continue
            scenes = f"{gap['scenes']} scene{'s' * (gap['scenes'] > 1)}"
            name = mean["method"] + NOTES[mean["tracks"]]
            line = (
                f"{name}, {GROUP_PLACES[group]}: moving vehicles {_with_interval(moving, '{:.1f}')} dB, a gap "
                f"of {_with_interval(gap, '{:.1f}')} dB to static pixels, {scenes}"
            )
            part = closed.get(mean["method"], {}).get(group)
            if part:
                percent = {name: part[name] and 100.0 * part[name] for name in ("low", "high")}
                share = _with_interval({"mean": 100.0 * part["fraction"], **percent}, "{:z.0f}")
                line += (
                    f"; against {report['reference']}: moving vehicles "
                    f"{_with_interval(part['moving_change'], '{:+z.1f}')} dB, {share} % of its gap closed; static "
                    f"pixels {_with_interval(part['static_change'], '{:+z.1f}')} dB"
                )
            lines.append(line)
    return lines


def _with_interval(found: dict[str, Any], form: str) -> str:
    if found["low"] is None or found["high"] is None:
        return form.format(found["mean"])
    return f"{form} ({form} to {form})".format(found["mean"], found["low"], found["high"])
