"""The costs of scenes on the page of the report."""

from collections.abc import Sequence
from html import escape
from typing import Any

HEADS = ("total, min", "trainings, min", "peak memory, GB", "on the GPU, GB", "under 90 minutes")


def costs_table(totals: Sequence[dict[str, Any]]) -> str:
    """A table with the summed costs of the jobs of each scene; empty without data."""
    if not totals:
        return ""
    methods = list(dict.fromkeys(method for total in totals for method in total["seconds_by_method"]))
    heads = ["stages of the scene, min", *(f"{method}, min" for method in methods), *HEADS]
    lines = "".join(f"<tr>{_line(total, methods)}</tr>" for total in totals)
    return (
        '<h2>Costs</h2><div class="card wide"><table><thead><tr><th class="name">scene</th>'
        + "".join(f"<th>{escape(head)}</th>" for head in heads)
        + f"</tr></thead><tbody>{lines}</tbody></table></div>"
        '<p class="soft">Sums over jobs, films and exports included, at the time of this page; jobs that run in '
        "parallel take less. Variants of an ablation are not included. costs.csv lists every job.</p>"
    )


def _line(total: dict[str, Any], methods: Sequence[str]) -> str:
    minutes = [total["scene_seconds"], *(total["seconds_by_method"].get(method) for method in methods)]
    memory, on_gpu = total["max_rss_mb"], total["gpu_memory_gb"]
    cells = [
        *(_minutes(value) for value in (*minutes, total["seconds"], total["training_seconds"])),
        "–" if memory is None else f"{memory / 1000:.1f}",
        "–" if on_gpu is None else f"{on_gpu:.1f}",
        ("yes" if total["under_90_minutes"] else "no") + ("" if total["complete"] else ", so far"),
    ]
    return f'<td class="name">{escape(total["scene"])}</td>' + "".join(f"<td>{cell}</td>" for cell in cells)


def _minutes(seconds: float | None) -> str:
    return "–" if seconds is None else f"{seconds / 60:.1f}"
