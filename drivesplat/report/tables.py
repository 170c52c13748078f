"""The tables of the report: as CSV, and as text for the console."""

from pathlib import Path
from typing import Any

import pandas as pd

from drivesplat.io.storage import atomic_write
from drivesplat.report.aside import aside_columns, aside_table
from drivesplat.report.gaps import COLUMNS, HUMANS, REGIONS, shows_other_tracks, shows_people
from drivesplat.report.lidar import LIDAR_COLUMNS, REGION_NAMES, page_table
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.settings.published import MEAN

NAMES, COSTS = ["scene", "method"], ["gaussians", "train_seconds"]
TITLES = {
    "moving_vehicle": "moving",
    "gap_db": "gap",
    "moving_human": "people",
    "human_gap_db": "their gap",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
}
FORMS = {"ssim": "{:.3f}", "lpips": "{:.3f}", "gaussians": "{:,.0f}", "train_seconds": "{:,.0f}"}
"""The formats of figures; all others are in dB with two digits."""


def figures_of(report: dict[str, Any]) -> pd.DataFrame:
    """The figures of a report, a row per scene and method; None where there is none."""
    return pd.DataFrame(report["rows"], columns=list(COLUMNS), dtype=object)


def write_figures(path: str | Path, report: dict[str, Any]) -> None:
    """Writes the figures of a report as CSV; missing ones are empty cells. Where there are views from beside the path,
    their figures follow; where methods render LiDAR, LIDAR_COLUMNS, and rows of the baselines. Published figures of
    whole images follow, in the same columns, with their source; so do the measured means that they are compared with.
    """
    table, names = figures_of(report), ["scene", "dataset", "method"]
    if columns := aside_columns(report["aside"]["rows"]):
        added = [dict(zip(names, key, strict=True)) | figures for key, figures in columns.items()]
        table = table.merge(pd.DataFrame(added, dtype=object), how="left")
    if report["lidar"]["rows"]:
        scans = pd.DataFrame(report["lidar"]["rows"], dtype=object)
        shown, of_baselines = [*names, *LIDAR_COLUMNS], scans["baseline"].astype(bool)
        table = pd.concat([table.merge(scans.loc[~of_baselines, shown], how="left"), scans.loc[of_baselines, shown]])
    if report["published"]:
        added = []
        for row in report["published"]:
            if row["region"] == "all" and (not row["measured"] or row["scene"] == MEAN):
                figures = {"psnr_frame_mean": row["psnr"], "ssim": row["ssim"], "lpips": row["lpips"]}
                seconds = None if row["train_minutes"] is None else round(60.0 * row["train_minutes"], 1)
                line = {"scene": row["scene"], "method": row["method"], "train_seconds": seconds}
                line |= {f"{row['group']}_{name}": value for name, value in figures.items()}
                added.append(line | ({} if row["measured"] else {"source": row["source"], "url": row["url"]}))
        table = pd.concat([table, pd.DataFrame(added, columns=[*COLUMNS, "source", "url"], dtype=object)])
    with atomic_write(path) as file:
        file.write(table.to_csv(index=False).encode())


def gap_table(report: dict[str, Any]) -> str:
    """PSNR by region with the gap, and those of people where any move, in both groups of held-out frames, and the means
    over scenes."""
    return _as_text(report, [*REGIONS, "gap_db", *(HUMANS if shows_people(report) else ())], [])


def whole_image_table(report: dict[str, Any]) -> str:
    """PSNR, SSIM and LPIPS of whole images in both groups, Gaussians and training time, and the means over scenes."""
    return _as_text(report, ["psnr", "ssim", "lpips"], COSTS)


def aside_tables(report: dict[str, Any]) -> list[str]:
    """A heading and a table of views from beside the path: a line per view, scene and method, and the means over
    scenes. Empty where there are none."""
    table = aside_table(report["aside"])
    shown = [(row["scene"], row, row) for row in table["rows"]]
    shown += [("mean", mean, mean["figures"]) for mean in table["means"]]
    lines = [
        [scene, names["place"], names["method"], *(_cell(figures[c["key"]], c["form"]) for c in table["columns"])]
        for scene, names, figures in shown
    ]
    heads = [column["title"].rstrip(" ↑↓") for column in table["columns"]]
    text = pd.DataFrame(lines, columns=["scene", "view", "method", *heads], dtype=object).to_string(index=False)
    return ["Views from beside the recorded path", text] if lines else []


def lidar_tables(report: dict[str, Any]) -> list[str]:
    """A heading and a table of rendered LiDAR, of all rays in both groups: a line per scene and method or baseline, and
    the means over scenes. Empty where no method renders LiDAR."""
    table = page_table(report["lidar"])
    columns = [column for column in table["columns"] if column["of"][1] != "rays"]
    lines = [
        [item["scene"] or "mean", item["method"], *(_cell(item["figures"][c["key"]], c["form"]) for c in columns)]
        for item in (*table["rows"], *table["means"])
        if item["region"] == REGION_NAMES["all"]
    ]
    firsts = [f"{column['of'][0][:6]}. " if column["kind"] == "first" else "" for column in columns]
    titles = [column["title"].partition(",")[0].rstrip(" ↑↓") for column in columns]
    heads = [first + title for first, title in zip(firsts, titles, strict=True)]
    text = pd.DataFrame(lines, columns=[*NAMES, *heads], dtype=object).to_string(index=False)
    title = "LiDAR, all rays of held-out scans (range: median error in cm; drops in %; Chamfer in m)"
    return [title, text] if lines else []


def _cell(value: Any, form: str) -> str:
    number = value["mean"] if isinstance(value, dict) else value
    return "-" if number is None else form.format(number)


def published_tables(report: dict[str, Any]) -> list[str]:
    """Published figures and those measured on the same scenes, a heading and a table per publication: a line per
    method, and whether it was measured here."""
    forms = {"psnr": "{:.2f}", "ssim": "{:.3f}", "lpips": "{:.3f}", "train_minutes": "{:.1f}"}
    lines: dict[str, list[dict[str, str]]] = {}
    for row in report["published"]:
        names = {"scene": scene_label(row), "pixels": pixels_label(row)}
        names["method"] = f"{row['method']} (here)" if row["measured"] else row["method"]
        figures = {name: "-" if row[name] is None else form.format(row[name]) for name, form in forms.items()}
        lines.setdefault(row["source"], []).append(names | figures)
    titles = {**TITLES, "train_minutes": "minutes"}
    tables = {source: pd.DataFrame(own).rename(columns=titles).to_string(index=False) for source, own in lines.items()}
    return [
        text
        for source, table in tables.items()
        for text in (f"Beside the figures of {source} (PSNR: mean over images)", table)
    ]


def scene_label(row: dict[str, Any]) -> str:
    """The scene of a row of published or measured figures; of a mean also the number of scenes, where it is known."""
    return row["scene"] if row["scenes"] is None else f"{row['scene']} of {row['scenes']}"


def pixels_label(row: dict[str, Any]) -> str:
    """The pixels of a row of published or measured figures, and the group of held-out images if it is the harder."""
    region = "whole images" if row["region"] == "all" else row["region"].replace("_", " ")
    return region if row["group"] == HELD_OUT_GROUPS[0] else f"{region}, {row['group']}"


def _as_text(report: dict[str, Any], of_groups: list[str], of_methods: list[str]) -> str:
    means = [
        {
            "scene": "mean",
            "method": mean["method"],
            "tracks": mean["tracks"],
            **{name: it and it["mean"] for name, it in mean["figures"].items()},
        }
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
    names = [*NAMES, *(["tracks"] if shows_other_tracks(report) else [])]
    return table[[*names, *columns]].rename(columns=titles).to_string(index=False)
