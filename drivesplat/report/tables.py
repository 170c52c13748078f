"""The tables of the report: as CSV, and as text for the console."""

from pathlib import Path
from typing import Any

import pandas as pd

from drivesplat.io.storage import atomic_write
from drivesplat.report.gaps import COLUMNS, REGIONS, WHOLE_IMAGE
from drivesplat.scene.splits import HELD_OUT_GROUPS

NAMES, COSTS = ["scene", "method"], ["gaussians", "train_seconds"]
TITLES = {"moving_vehicle": "moving", "gap_db": "gap", "psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS"}
FORMS = {"ssim": "{:.3f}", "lpips": "{:.3f}", "gaussians": "{:,.0f}", "train_seconds": "{:,.0f}"}
"""The formats of figures; all others are in dB with two digits."""


def figures_of(report: dict[str, Any]) -> pd.DataFrame:
    """The figures of a report, a row per scene and method; None where there is none."""
    return pd.DataFrame(report["rows"], columns=list(COLUMNS), dtype=object)


def write_figures(path: str | Path, report: dict[str, Any]) -> None:
    """Writes the figures of a report as CSV; missing ones are empty cells."""
    with atomic_write(path) as file:
        file.write(figures_of(report).to_csv(index=False).encode())


def gap_table(report: dict[str, Any]) -> str:
    """PSNR by region with the gap, in both groups of held-out frames, and the means over scenes."""
    return _as_text(report, [*REGIONS, "gap_db"], [])


def whole_image_table(report: dict[str, Any]) -> str:
    """PSNR, SSIM and LPIPS of whole images in both groups, Gaussians and training time, and the means over scenes."""
    return _as_text(report, list(WHOLE_IMAGE), COSTS)


def _as_text(report: dict[str, Any], of_groups: list[str], of_methods: list[str]) -> str:
    means = [
        {"scene": "mean", "method": mean["method"], **{name: it and it["mean"] for name, it in mean["figures"].items()}}
        for mean in report["means"]
    ]
    columns = {f"{group}_{name}": name for group in HELD_OUT_GROUPS for name in of_groups}
    columns |= {name: name for name in of_methods}
    table = pd.concat([figures_of(report), pd.DataFrame(means, columns=list(COLUMNS), dtype=object)])
    for column, name in columns.items():
        form = FORMS.get(name, "{:.2f}")
        table[column] = [
            "-" if value is None or value != value else form.format(value) for value in table[column].tolist()
        ]
    titles = {column: TITLES.get(name, name) for column, name in columns.items()}
    titles |= {f"{group}_{of_groups[0]}": f"{group[:6]}. {TITLES[of_groups[0]]}" for group in HELD_OUT_GROUPS}
    titles["train_seconds"] = "seconds"
    return table[[*NAMES, *columns]].rename(columns=titles).to_string(index=False)
