"""Published figures beside the figures that were measured here, as records for the page, the JSON and the tables."""

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import mean
from typing import Any

from drivesplat.settings.published import FIGURES, MEAN, PublishedFigures

Place = tuple[str, str]
"""A group of held-out images and a region."""
Measured = dict[str, dict[Place, dict[str, Any]]]
"""The figures of a scene's methods: `psnr` as mean over images, `ssim`, `lpips`, `train_minutes` and `gpu`."""
_KEYS = {"psnr": "psnr_frame_mean", "ssim": "ssim", "lpips": "lpips"}


def measured_figures(record: Mapping[str, Any], published: Sequence[PublishedFigures]) -> Measured:
    """The figures of a metrics.json in the groups and regions of the published ones. A region without enough pixels has
    none. Raises KeyError, TypeError or ValueError where the record is not one of figures."""
    places = dict.fromkeys((item.group, item.region) for item in published)
    return {
        method: {place: _figures(result, *place) for place in places} for method, result in record["methods"].items()
    }


def _figures(result: Mapping[str, Any], group: str, region: str) -> dict[str, Any]:
    pixels = result[group][region] or {}
    found = {name: pixels.get(key) for name, key in _KEYS.items()}
    seconds = result["train_seconds"]
    found["train_minutes"] = None if seconds is None else seconds / 60.0
    for name, value in found.items():
        if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
            raise ValueError(f"{name} of {region} is {value!r}, not a number")
    return {**found, "gpu": str(result.get("device") or "") or None}


def beside_published(published: Sequence[PublishedFigures], scenes: Mapping[str, Measured]) -> list[dict[str, Any]]:
    """A row per published and per measured method, by publication, scene and region in the order of `published`: the
    published ones first, then those measured on `scenes`. `measured` tells them apart; `scenes` is the number of scenes
    of a mean. A measured mean has figures only if it is over as many scenes as the published one."""
    rows = []
    sources: dict[str, dict[tuple[Any, ...], list[PublishedFigures]]] = {}
    for item in published:
        key = (item.source, item.scene, item.scenes, item.group, item.region)
        sources.setdefault(item.source, {}).setdefault(key, []).append(item)
    # by what is compared with them, those of a publication one after another
    comparisons = (comparison for of_source in sources.values() for comparison in of_source.items())
    for (source, scene, count, group, region), items in comparisons:
        place = {"source": source, "url": items[0].url, "scene": scene, "group": group, "region": region}
        for item in items:
            own = item.model_dump(include={*FIGURES, "gpu"})
            rows.append({**place, "method": item.method, "measured": False, "scenes": count, **own})
        if scene == MEAN:
            found = _means((group, region), scenes.values(), count)
        else:
            of_scene = scenes.get(scene, {})
            found = [
                {"method": method, "scenes": None, **figures[group, region]} for method, figures in of_scene.items()
            ]
        rows += [{**place, "measured": True, **row} for row in found]
    return rows


def _means(place: Place, scenes: Iterable[Measured], count: int | None) -> list[dict[str, Any]]:
    """The means of every method over the scenes; without figures where their number is not `count`, and without a
    figure that a scene lacks."""
    methods: dict[str, list[dict[str, Any]]] = {}
    for measured in scenes:
        for method, figures in measured.items():
            methods.setdefault(method, []).append(figures[place])
    rows = []
    for method, of_scenes in methods.items():
        comparable = count is None or count == len(of_scenes)
        values = {name: [own[name] for own in of_scenes] for name in FIGURES}
        figures = {name: mean(own) if comparable and None not in own else None for name, own in values.items()}
        gpus = {own["gpu"] for own in of_scenes}
        gpu = gpus.pop() if len(gpus) == 1 else None
        rows.append({"method": method, "scenes": len(of_scenes), **figures, "gpu": gpu})
    return rows
