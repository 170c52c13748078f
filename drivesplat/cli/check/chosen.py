"""The recording that a check is asked for: that of a folder, whose format is recognised, or that of a config file."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivesplat.errors import DatasetError, RequestError
from drivesplat.io.this_copy import default_config, of_the_workflow
from drivesplat.io.yaml_file import read_yaml
from drivesplat.readers.datasets import layout, missing_package
from drivesplat.readers.recognised import Recognised, format_name, in_folder, known_formats
from drivesplat.settings.config import Config, load, merged
from drivesplat.settings.names import suggestion

CONFIGS = (".yaml", ".yml")
DRIVE_FILE = "drive.json"
BAGS = (".bag", ".mcap", ".db3")
MAX_NAMED = 10
"""Maximum number of scenes that a line names."""
DATASET = "mine"
"""The name of the dataset in proposed settings, unless config.yaml has a dataset with a scene of that name."""


@dataclass(frozen=True)
class ChosenScene:
    """The scene `name` of a recording in the folder `root`, as the settings of a dataset name them; `others` are the
    scenes beside it, and `said` how it was found. `values` are the settings of config.yaml, with `of_config` those of a
    config file laid over them, which has the `dataset`."""

    reader: str
    root: Path
    version: str
    name: str
    others: tuple[str, ...]
    said: str
    dataset: str = DATASET
    frames: tuple[int, int] | None = None
    values: dict[str, Any] = field(default_factory=dict)
    of_config: bool = False


def chosen_scene(place: Path, scene: str | None, version: str | None = None) -> ChosenScene:
    """The scene to check at `place`: a folder, a drive.json, or a config file. `scene` and `version` select one; by
    default the first. Raises DatasetError for what is no recording, RequestError for a scene that is not there."""
    if not place.exists():
        raise DatasetError(f"there is no {place}; name the folder of a recording, or a config file")
    if place.name == DRIVE_FILE:
        place = place.absolute().parent
    if place.is_file() and place.suffix in CONFIGS:
        return _of_config(place, scene)
    found = in_folder(place) if place.is_dir() else {}
    if not found and any(file.suffix in BAGS for file in ([place] if place.is_file() else place.iterdir())):
        raise DatasetError(
            f"{place} is a bag of ROS; `drivesplat import bag {place} --propose topics.yaml` begins to make it a drive "
            "folder (docs/own_data.md)"
        )
    if not found:
        raise DatasetError(
            f"{place} is no recording that can be read: looked for {known_formats()}; docs/own_data.md says how to "
            "convert others"
        )
    if len(found) > 1:
        held = ", ".join(f"{format_name(name)} ({one[0].sign})" for name, one in found.items())
        raise DatasetError(f"{place} holds several formats: {held}; name the folder of one of them")
    ((reader, recordings),) = found.items()
    return _of_folder(reader, recordings, scene, version)


def _of_folder(reader: str, recordings: list[Recognised], scene: str | None, version: str | None) -> ChosenScene:
    chosen = [one for one in recordings if version in (None, one.version)]
    if not chosen:
        known = ", ".join(one.version for one in recordings)
        raise RequestError(f"there is no version {version}; there are: {known}")
    holding = [one for one in chosen if scene in (None, *one.scenes)]
    if not holding:
        every = [name for one in chosen for name in one.scenes]
        meant = suggestion(scene or "", every)
        raise RequestError(f"there is no scene {scene!r} in {chosen[0].root}; {meant}there are: {_named(every)}")
    one = holding[0]
    if not one.scenes:
        raise DatasetError(f"{one.sign.parent} holds no scene; unpack it again")
    name = scene or one.scenes[0]
    several = f", version {one.version}" if len(recordings) > 1 else ""
    said = f"format: {format_name(reader)}, by {one.sign}{several}"
    if len(one.scenes) > 1:
        said += f"; {len(one.scenes)} scenes: {_named(one.scenes)}"
    others = tuple(other for other in one.scenes if other != name)
    values = read_yaml(default_config(Path.cwd()), "config file") or {}
    dataset = load(values).dataset_names.get(name, DATASET)
    return ChosenScene(reader, one.root, one.version, name, others, said, dataset, values=values)


def _of_config(file: Path, scene: str | None) -> ChosenScene:
    """The scene of a config file: by default the first of the recorded datasets that it names, or of all."""
    given = read_yaml(file, "config file") or {}
    if not isinstance(given, dict):
        raise RequestError(f"{file}: it is no config file, which holds lines 'key: value'")
    values = merged(read_yaml(default_config(Path.cwd()), "config file") or {}, given)
    config = load(values)
    own = [name for name in given.get("datasets") or () if name in config.datasets]
    recorded = [name for name in own or config.datasets if config.datasets[name].world is None]
    if scene is None and not recorded:
        raise RequestError(f"{file} names synthetic worlds alone, which the workflow makes; --scene names a recording")
    scene = scene or config.datasets[recorded[0]].scenes[0]
    name = config.dataset_of(scene)
    dataset = config.datasets[name]
    if dataset.world is not None:
        raise RequestError(f"scene {scene} is a synthetic world, which the workflow makes as the settings say")
    if problem := missing_package(dataset.reader):
        raise DatasetError(problem)
    root = layout(dataset.reader).find_root(dataset.dataroot, dataset.version)
    others = tuple(other for other in dataset.scenes if other != scene)
    said = f"format: {format_name(dataset.reader)} in {root}, by the dataset {name} of {file}"
    if others:
        said += f"; {len(dataset.scenes)} scenes: {_named(dataset.scenes)}"
    return ChosenScene(
        dataset.reader,
        root,
        dataset.version,
        scene,
        others,
        said,
        name,
        dataset.frames.get(scene),
        values,
        of_config=True,
    )


def config_of(chosen: ChosenScene, settings: dict[str, Any], *presets: str) -> Config:
    """The config of a scene with `settings` laid over its values and over `presets`."""
    values = chosen.values
    for preset in presets:
        values = merged(values, read_yaml(of_the_workflow(preset), "preset") or {})
    return load(merged(values, settings))


def _named(names: tuple[str, ...] | list[str]) -> str:
    more = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")
