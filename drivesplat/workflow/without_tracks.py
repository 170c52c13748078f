"""Drives without boxes: the method that takes the place of the shipped `street` there, and what planning says of it."""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Any

from drivesplat.errors import DatasetError
from drivesplat.readers.by_name import dataset_module, has_module
from drivesplat.readers.datasets import layout
from drivesplat.readers.outline import Outline
from drivesplat.settings.blocks import drive_of
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.method import MethodSettings
from drivesplat.settings.without_boxes import DISCOVERED, HOW, REPLACED, reason, substitute

ANNOTATED = "drivesplat.readers.*.annotated"
"""The module that tells whether a recording has tracks, of readers that know it at once."""
MAX_NAMED = 4
"""Maximum number of scenes that a sentence names."""


def recorded_outline(config: Config, scene: str) -> Outline | None:
    """The outline of a scene's recording, of a block that of its drive; None where its reader gives none, or the
    recording is absent."""
    scene = drive_of(scene) if config.is_block(scene) else scene
    if scene not in config.outlines:
        module = layout(_reader(config, scene))
        config.outlines[scene] = _answer(config, scene, getattr(module, "outline", None))
    return config.outlines[scene]


def lacks_tracks(config: Config, scene: str) -> bool:
    """Whether a scene's recording, of a block that of its drive, has no annotated track, as far as its reader tells
    before it is read."""
    scene = drive_of(scene) if config.is_block(scene) else scene
    if scene not in config.untracked:
        reader = _reader(config, scene)
        ask = dataset_module(ANNOTATED, reader).has_tracks if has_module(ANNOTATED, reader) else None
        config.untracked[scene] = _answer(config, scene, ask) is False
    return config.untracked[scene]


def _reader(config: Config, scene: str) -> str:
    return config.datasets[config.dataset_of(scene)].reader


def _answer(config: Config, scene: str, ask: Callable[[Path, str, str], Any] | None) -> Any:
    """What a function of a reader says of the root, version and name of a scene. None without such a function, for a
    synthetic world, and for an absent recording, which planning refuses where a target needs it."""
    dataset = config.datasets[config.dataset_of(scene)]
    if ask is None or dataset.world:
        return None
    try:
        return ask(layout(dataset.reader).find_root(dataset.dataroot, dataset.version), dataset.version, scene)
    except DatasetError:
        return None


def in_place_of_street(config: Config, scene: str) -> str | None:
    """The method that takes the place of the shipped `street` on a scene; None where `street` stays as it is, or is no
    method of the config."""
    there = for_scene(config, scene)
    if not (there.substitutes and there.cameras and there.replace_street and lacks_tracks(config, scene)):
        return None
    outline = recorded_outline(config, scene)
    return DISCOVERED if outline is None else substitute(outline.sweeps, outline.without_beams)


def methods_of(config: Config, scene: str) -> dict[str, MethodSettings]:
    """The methods of a scene by name, in order: those of the config, on a drive without boxes with another one in place
    of the shipped `street`."""
    other = in_place_of_street(config, scene)
    names = [other if other and name == REPLACED else name for name in config.methods]
    return {name: config.all_methods[name] for name in names}


def known_methods(config: Config, scene: str) -> dict[str, MethodSettings]:
    """The methods that targets of a scene may name: its own, those of the config, and the variants of the ablation; on
    a drive without boxes also both that may take the place of `street`."""
    known = {**methods_of(config, scene), **config.methods, **config.ablated}
    return {**known, **config.substitutes} if in_place_of_street(config, scene) else known


def methods_without_boxes(config: Config, scenes: Iterable[str], trained: Collection[tuple[str, str]]) -> list[str]:
    """Sentences about those of `scenes` that have no boxes, one for all alike: the method that takes the place of
    `street` and why, and methods with annotated tracks, which have no objects there. `trained` are the pairs of scene
    and method of the run."""
    replaced: dict[tuple[str, tuple[str, ...]], list[str]] = defaultdict(list)
    empty: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for scene in sorted(set(scenes)):
        if not lacks_tracks(config, scene):
            continue
        own, other = methods_of(config, scene), in_place_of_street(config, scene)
        if other and ((scene, other) in trained or (scene, REPLACED) not in trained):
            replaced[other, tuple(own)].append(scene)
        idle = tuple(
            name
            for name, method in config.all_methods.items()
            if (scene, name) in trained and method.object_parts and method.tracks == "annotated"
        )
        if idle:
            empty[idle].append(scene)
    return [
        *(
            f"{_named(found)} {reason(other)}; methods there: {', '.join(own)} ({HOW})"
            for (other, own), found in replaced.items()
        ),
        *(
            f"{_named(found)} no boxes: methods with annotated tracks have no objects there ({', '.join(idle)}); {HOW} "
            "has others"
            for idle, found in empty.items()
        ),
    ]


def _named(scenes: list[str]) -> str:
    """Some scenes as the beginning of a sentence, with its verb."""
    if len(scenes) == 1:
        return f"scene {scenes[0]} has"
    more = len(scenes) - MAX_NAMED
    return f"scenes {', '.join(scenes[:MAX_NAMED])}{f' and {more} more' if more > 0 else ''} have"
