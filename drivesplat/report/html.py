"""gap_report.html: a page with embedded images, which needs no network, and links to films and viewers."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path, PurePosixPath
from typing import Any

from drivesplat.evaluation.comparison import GROUP_PLACES
from drivesplat.io.html_page import json_in_html
from drivesplat.report.costs import costs_table
from drivesplat.report.gaps import summary_sentences
from drivesplat.report.media import MethodMedia, data_url, difference_position, image_data_url, read_image
from drivesplat.report.page import filled_page
from drivesplat.report.plot import gap_plot
from drivesplat.scene.splits import HELD_OUT_GROUPS

MediaByMethod = Mapping[tuple[str, str], MethodMedia]
COLUMNS = {
    "static": ("static", "{:.1f}"), "vehicle": ("vehicle", "{:.1f}"), "moving_vehicle": ("moving", "{:.1f}"),
    "gap_db": ("gap", "{:.1f}"), "lpips": ("LPIPS", "{:.3f}"),
}  # fmt: skip
"""Of a group of held-out frames: the keys of figures, their column titles and formats."""
COSTS = {"gaussians": ("Gaussians", "{:,.0f}"), "train_seconds": ("training, s", "{:,.0f}")}
NOTHING = "Nothing has been measured yet."


def report_page(report: dict[str, Any], media: MediaByMethod, costs: Sequence[dict[str, Any]] = ()) -> str:
    """The page of a report with the `media` by scene and method and the total costs of scenes; links are relative to
    the report's folder. Raises ResultError if an image cannot be read."""
    return filled_page(
        introduction=_introduction(report),
        plot=_card(gap_plot(report), "plot"),
        table=_table(report),
        absent=_absent(report),
        scenes=_scenes(report, media),
        protocol=_protocol(report),
        costs=costs_table(costs),
        report=json_in_html(report),
    )


def _introduction(report: dict[str, Any]) -> str:
    measured = len(dict.fromkeys(row["scene"] for row in report["rows"]))
    configured = measured + len(report["left_out"]) + len(report["missing"])
    state = f"{measured} of {configured} configured scenes"
    mark = f'<p class="partial">Partial: {state}; the others are listed below.</p>' if report["partial"] else ""
    sentences = "".join(f"<li>{escape(line)}</li>" for line in summary_sentences(report))
    return (
        '<p class="soft">PSNR in dB on held-out images: static pixels compared with pixels of moving vehicles. '
        f"{'' if report['partial'] else f'All {state}.'}</p>{mark}<ul>{sentences or f'<li>{NOTHING}</li>'}</ul>"
    )


def _card(content: str, kind: str) -> str:
    return f'<div class="card {kind}">{content}</div>' if content else ""


def _table(report: dict[str, Any]) -> str:
    if not report["rows"]:
        return f"<p>{NOTHING}</p>"
    names, fields = ["scene", "method"], [(f"{g}_{key}", how) for g in HELD_OUT_GROUPS for key, how in COLUMNS.items()]
    fields += list(COSTS.items())
    span = f'<th class="group" colspan="{len(COLUMNS)}">'
    groups = "".join(f"{span}{GROUP_PLACES[group]}</th>" for group in HELD_OUT_GROUPS)
    heads = [_column_title(i, name, "name") for i, name in enumerate(names)]
    heads += [_column_title(i, how[0], _border(key)) for i, (key, how) in enumerate(fields, start=len(names))]
    lines = [
        "".join(_cell(row[name], "{}", "name") for name in names)
        + "".join(_cell(row[key], how[1], _border(key)) for key, how in fields)
        for row in report["rows"]
    ]
    means = [
        f'<td class="name">mean</td><td class="name">{escape(mean["method"])}</td>'
        + "".join(_mean_cell(mean["figures"][key], how[1], _border(key)) for key, how in fields)
        for mean in report["means"]
    ]
    body, foot = (f"<tr>{'</tr><tr>'.join(rows)}</tr>" for rows in (lines, means))
    return (
        '<div class="card wide"><table class="sortable"><thead>'
        f'<tr><th class="name" colspan="2"></th>{groups}<th class="group" colspan="{len(COSTS)}"></th></tr>'
        f"<tr>{''.join(heads)}</tr></thead><tbody>{body}</tbody><tfoot>{foot}</tfoot></table></div>"
        '<p class="soft">Means are over the scenes that have the figure; means of the gap are over scenes with moving '
        "vehicles (elsewhere the gap of a row is that of parked vehicles), with their 95 % confidence intervals "
        "(percentile bootstrap over scenes). A dash: no such pixels, or not measured.</p>"
    )


def _border(key: str) -> str:
    return "first" if key.endswith("_static") or key == "gaussians" else ""


def _column_title(column: int, name: str, kind: str) -> str:
    return f'<th class="{kind}" data-column="{column}"><button type="button">{escape(name)}</button></th>'


def _cell(value: Any, fmt: str, kind: str) -> str:
    sorted_by = "" if value is None else escape(str(value))
    return f'<td class="{kind}" data-value="{sorted_by}">{_formatted(value, fmt)}</td>'


def _mean_cell(found: dict[str, Any] | None, fmt: str, kind: str) -> str:
    if found is None:
        return f'<td class="{kind}">–</td>'
    interval = ""
    if found["low"] is not None and found["high"] is not None:
        interval = f'<span class="soft">{fmt.format(found["low"])} to {fmt.format(found["high"])}</span>'
    return f'<td class="{kind}">{fmt.format(found["mean"])}{interval}</td>'


def _formatted(value: Any, fmt: str) -> str:
    return "–" if value is None else escape(fmt.format(value))


def _absent(report: dict[str, Any]) -> str:
    lines = [(item["scene"], f"left out: {item['why']}") for item in report["left_out"]]
    lines += [(item["scene"], item["why"]) for item in report["missing"]]
    listed = "".join(f"<li><b>{escape(scene)}</b>: {escape(why)}</li>" for scene, why in lines)
    return f'<h2>Not in the table</h2><div class="card"><ul>{listed}</ul></div>' if lines else ""


def _scenes(report: dict[str, Any], media: MediaByMethod) -> str:
    scenes: dict[str, list[dict[str, Any]]] = {}
    for row in report["rows"]:
        scenes.setdefault(row["scene"], []).append(row)
    return "".join(_scene(scene, rows, media) for scene, rows in scenes.items()) or f"<p>{NOTHING}</p>"


def _scene(scene: str, rows: Sequence[dict[str, Any]], media: MediaByMethod) -> str:
    methods = "".join(_method(row, media.get((scene, row["method"]), MethodMedia())) for row in rows)
    title = f'{escape(scene)} <span class="soft">{escape(rows[0]["dataset"])}</span>'
    inside = f'<h3>{title}</h3><div class="looks">{methods}</div>'
    return f'<section class="card" id="scene-{escape(scene)}">{inside}</section>'


def _method(row: dict[str, Any], media: MethodMedia) -> str:
    images = media.images
    shown = []
    if "recorded" in images and "rendered" in images:
        what = f"{row['method']}: {_where(row['shown'])}"
        shown.append(_comparison(images["recorded"], images["rendered"], "recorded", row["method"], what))
    if "with_car" in images and "without_car" in images:
        sides = ("with vehicle", "without vehicle")
        what = f"{row['method']}: with and without a vehicle"
        shown.append(_comparison(images["with_car"], images["without_car"], *sides, what))
    if "panel" in images:
        shown.append(
            f'<figure><img class="panel" alt="ghost panel" src="{image_data_url(images["panel"])}">'
            f"<figcaption>{escape(row['method'])}: recorded and rendered moving vehicle, error, ghosts</figcaption>"
            "</figure>"
        )
    links = "".join(f'<a href="{escape(link)}">{escape(_link_name(link))}</a>' for link in media.links)
    figures = [
        f"{GROUP_PLACES[g]}: static {_formatted(row[f'{g}_static'], '{:.1f}')}, moving "
        f"{_formatted(row[f'{g}_moving_vehicle'], '{:.1f}')} dB"
        for g in HELD_OUT_GROUPS
    ]
    return (
        f'<div><p><b>{escape(row["method"])}</b> <span class="soft">{"; ".join(figures)}</span></p>'
        f'{"".join(shown)}<p class="links">{links}</p></div>'
    )


def _where(shown: dict[str, Any] | None) -> str:
    if shown is None:
        return "an image"
    if shown["group"] == "train":
        return f"key frame {shown['key_frame']}, a training image"
    return f"key frame {shown['key_frame']}, held out {GROUP_PLACES[shown['group']]}"


def _comparison(below: Path, above: Path, left: str, right: str, what: str) -> str:
    """Two images of one view with a slider between them, which starts where they differ."""
    images = read_image(below), read_image(above)
    start, (under, over) = f"{100 * difference_position(*images):.1f}", map(data_url, images)
    return (
        f'<figure><div class="compare"><img alt="{escape(left)}" src="{under}">'
        f'<img class="over" alt="{escape(right)}" src="{over}">'
        f'<span class="side left">{escape(left)}</span><span class="side right">{escape(right)}</span>'
        f'<input type="range" min="0" max="100" step="0.1" value="{start}" '
        f'aria-label="{escape(left)} or {escape(right)}">'
        f"</div><figcaption>{escape(what)}</figcaption></figure>"
    )


def _link_name(link: str) -> str:
    """The name of a file on the page: 'original.mp4', 'edits/remove.mp4'."""
    return "/".join(PurePosixPath(link).parts[2:])


def _protocol(report: dict[str, Any]) -> str:
    lines = "".join(
        f"<li><b>{escape(scene)}</b>: {escape(_measured(protocol))}</li>"
        for scene, protocol in report["protocols"].items()
    )
    return f'<div class="card"><ul>{lines or f"<li>{NOTHING}</li>"}</ul></div>'


def _measured(protocol: dict[str, Any]) -> str:
    held_out = protocol["held_out_frames"]
    frames = "; ".join(
        f"{GROUP_PLACES[group]} {', '.join(map(str, held_out[group])) or 'none'}" for group in HELD_OUT_GROUPS
    )
    return (
        f"{protocol['version']}, {protocol['eval_camera']} at {protocol['width']}x{protocol['height']}, "
        f"{protocol['train_images']} training images of {len(protocol['cameras'])} "
        f"camera{'s' * (len(protocol['cameras']) > 1)}, poses: {protocol['poses']}, regions: {protocol['regions']}, "
        f"held-out key frames: {frames}"
    )
