"""Settings that were given and do not hold, since a dataset or a method sets something else for itself."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from drivesplat.settings.config import Config, for_scene


def without_effect(config: Config, places: Iterable[tuple[str, str]]) -> list[str]:
    """A sentence for every setting of a `config` that is not its default and that is another one where it would count:
    in `places`, a scene each and a method or an empty name. What variants of an ablation set is meant to differ."""
    given, defaults = dict(_leaves(config.model_dump())), dict(_leaves(Config().model_dump()))
    told = {key: value for key, value in given.items() if defaults.get(key) != value}
    sentences: dict[str, None] = {}
    for scene, method in sorted(set(places)):
        if scene not in config.scenes:
            continue
        dataset, below = config.dataset_of(scene), given
        layers = [("dataset", dataset, for_scene(config, scene))]
        if method in config.methods:
            layers.append(("method", method, for_scene(config, scene, method)))
        for kind, name, there in layers:
            held = dict(_leaves(there.model_dump()))
            for key, value in told.items():
                if held.get(key, value) not in (value, below.get(key)):
                    where = f"{kind}s.{name}.overrides.{key}"
                    sentences[f"{key}: {value} does not hold for {kind} {name}, where {where} is {held[key]}"] = None
            below = held
    return list(sentences)


def _leaves(tree: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of a tree of settings that is no tree itself, with its path."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value
