"""A metrics.json as a table and in sentences: `drivesplat show results/demo`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from drivesplat.evaluation.comparison import GROUP_PLACES
from drivesplat.evaluation.figures_table import figures_table, metrics_of
from drivesplat.evaluation.views_aside import LATERAL, place_of_view, views_aside
from drivesplat.provenance.file_digests import checked_digest
from drivesplat.scene.scene_warnings import DARK

OUTPUTS = (
    "original.mp4", "lateral_2m.mp4", "parts.mp4", "lidar.mp4", "lidar.png", "ghost_panel.png", "removal.png",
    "viewer.html",
)  # fmt: skip
COMPARE_FILM, FILM_PAGE = "compare.mp4", "index.html"
MIN_NOVEL_DISTANCE = 0.1
"""Metres. At nuScenes' focal length a smaller step moves a point 10 m away by less than a dozen pixels."""


def sentences(metrics: dict[str, Any], path: str | Path) -> list[str]:
    """A sentence for each property of the drive that limits what the figures mean, for each method and group of
    held-out frames, for comparisons with truth, and for output files."""
    lines = []
    for group, where in GROUP_PLACES.items():
        held_out = metrics.get("drive", {}).get(group) or {}
        distance, flat = held_out.get("from_training_m"), held_out.get("flat_psnr")
        if distance is not None and distance < MIN_NOVEL_DISTANCE:
            lines.append(
                f"Frames {where} were taken {distance:.2f} m from training frames: their PSNR measures memorised "
                "views, not novel ones"
            )
        if flat is not None and held_out["luminance"] < DARK:
            lines.append(
                f"Frames {where} are dark (mean luminance {held_out['luminance']:.2f}): the trivial baseline, their "
                f"mean colour, has {flat:.1f} dB static"
            )
    if not metrics.get("protocol", {"cameras": True})["cameras"]:
        lines.append("The scene has no camera, so there are figures of LiDAR alone")
    elif not any(_psnr(method[group], "static") for method in metrics["methods"].values() for group in GROUP_PLACES):
        lines.append("No image is held out (holdout), so there are no figures of held-out images")
    if left_out := metrics.get("protocol", {}).get("left_out"):
        lines.append(f"Blocks are left out of the drive, and of all figures: {', '.join(left_out)}")
    for name, method in metrics["methods"].items():
        lines += [f"{name}{text}" for text in _of_method(method, metrics.get("lidar_baselines", {}))]
    folder = Path(path).parent
    lines.append(f"All figures: {path}; training curves and pictures: tensorboard --logdir {folder}")
    if (folder / FILM_PAGE).is_file():
        lines.append(f"Page with the films: {folder / FILM_PAGE}")
    if (folder / COMPARE_FILM).is_file():
        lines.append(f"All methods beside the recording: {folder / COMPARE_FILM}")
    for name in metrics["methods"]:
        there = [output for output in OUTPUTS if (folder / name / output).is_file()]
        there += ["edits/"] if (folder / name / "edits").is_dir() else []
        if there:
            lines.append(f"To look at, in {folder / name}: {', '.join(there)}")
    return lines


def _of_method(method: dict[str, Any], baselines: dict[str, Any]) -> list[str]:
    """The sentences of a method, without its name at their beginnings."""
    lines = []
    for group, where in GROUP_PLACES.items():
        found = method[group]
        if (static := _psnr(found, "static")) is not None:
            gap, moving = found.get("gap_db"), _psnr(found, "moving_vehicle")
            text = f"static {static:.1f} dB, no moving vehicle to compare with"
            if gap is not None and moving is not None:
                text = f"moving vehicles {moving:.1f} dB, static {static:.1f} dB: a gap of {gap:.1f} dB"
            people, gap = _psnr(found, "moving_human"), found.get("human_gap_db")
            if people is not None and gap is not None:
                text += f"; moving people {people:.1f} dB: a gap of {gap:.1f} dB"
            lines.append(f", frames {where}: {text}")
        if regions := found.get("lidar"):
            forms = "range off by {:.1f} cm in the median", "intensity by {:.3f}", "{:.1f} % of returns and drops right"
            own = _scan_figures(regions, forms) or f"no figures, {regions['all'].get('unavailable')}"
            short = ("{:.1f} cm", "{:.3f}", "{:.1f} %")
            others = {name: _scan_figures(groups[group], short) for name, groups in baselines.items()}
            beside = "; ".join(f"{name.replace('_', ' ')}: {figures}" for name, figures in others.items() if figures)
            lines.append(f", LiDAR scans {where}: {own}" + (f" ({beside})" if beside else ""))
    for kind, key in views_aside([method]):
        view = method[kind][key]
        psnrs = {"static": _psnr(view, "static"), "moving vehicles": _psnr(view, "moving_vehicle")}
        figures = [f"{name} {psnr:.1f} dB" for name, psnr in psnrs.items() if psnr is not None]
        if depth := view.get("depth"):
            figures.append(f"depth off by {depth['median_relative_error']:.1%} in the median".replace("%", " %"))
        if figures:
            against = "truth" if kind == LATERAL else "images left out of training"
            lines.append(f", from {place_of_view((kind, key))}, against {against}: {', '.join(figures)}")
    removal = method.get("removal", {})
    removed, before = (_psnr(regions, "box") for regions in (removal, removal.get("not_removed", {})))
    if removed is not None and before is not None:
        lines.append(
            f", the car ahead removed, against the empty street: {removed:.1f} dB in its box ({before:.1f} dB before)"
        )
    seconds, device = method["train_seconds"], method["device"]
    return [*lines, f": {method['gaussians']:,} Gaussians, trained in {seconds:.0f} s on {device}"]


def _psnr(regions: dict[str, Any], region: str) -> float | None:
    """The PSNR of a region, None if it is null or missing."""
    return (regions.get(region) or {}).get("psnr")


def _scan_figures(regions: dict[str, Any], forms: Iterable[str]) -> str:
    """Median error of range in cm, error of intensity, and drop accuracy in percent, those that are not null."""
    values = (regions["all"][key] for key in ("range_error_median_m", "intensity_rmse", "drop_accuracy"))
    return ", ".join(
        form.format(scale * value)
        for form, scale, value in zip(forms, (100.0, 1.0, 100.0), values, strict=True)
        if value is not None
    )


def print_summary(path: str | Path) -> None:
    """Prints the table and the sentences of a scene's metrics, given its folder or metrics.json. Raises ResultError
    where the file is absent or damaged."""
    file, metrics = metrics_of(path)
    checked_digest(file, warn=False)
    table = figures_table([metrics])
    print("\n".join([*table, *[""][: len(table)], *sentences(metrics, file)]))
