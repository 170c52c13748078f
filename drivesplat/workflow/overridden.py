"""Settings without effect, since an override of a dataset or a method replaces them."""

from collections.abc import Iterable

from drivesplat.io.storage import leaves
from drivesplat.settings.config import Config, for_scene


def without_effect(config: Config, places: Iterable[tuple[str, str]]) -> list[str]:
    """One sentence for every setting that is not at its default and that an override replaces in one of `places`: pairs
    of a scene and a method, or of a scene and an empty name. Overrides of ablation variants are not reported."""
    given, defaults = leaves(config.model_dump()), leaves(Config().model_dump())
    changed = {key: value for key, value in given.items() if defaults.get(key) != value}
    if not changed:
        return []
    sentences: dict[str, None] = {}
    scenes = {(config.dataset_of(scene), method): scene for scene, method in places if scene in config.dataset_names}
    for (dataset, method), scene in sorted(scenes.items()):
        below = given
        layers = [("dataset", dataset, for_scene(config, scene))]
        if method in config.methods:
            layers.append(("method", method, for_scene(config, scene, method)))
        for kind, name, there in layers:
            used = leaves(there.model_dump())
            for key, value in changed.items():
                if used.get(key, value) not in (value, below.get(key)):
                    where = f"{kind}s.{name}.overrides.{key}"
                    sentences[f"{key}: {value} does not hold for {kind} {name}, where {where} is {used[key]}"] = None
            below = used
    return list(sentences)
