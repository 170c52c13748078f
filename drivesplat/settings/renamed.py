"""Settings that have other names since the last version. Their old names hold in this version, with a note."""

from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from typing import Any

from drivesplat.errors import ConfigError

RENAMED = {
    "train.checkpoint_apart_s": "min_checkpoint_interval_s",
    "train.coarse_to_fine.least_height": "min_height",
    "train.coarse_to_fine.share": "fraction",
    "train.drifting.share": "fraction",
    "train.drifting.seed.share": "fraction",
    "train.gaussians.lr_echoes": "lr_lidar_logits",
    "train.actors.least": "min_gaussians",
    "train.actors.tracks.size_weight": "l2_weight",
    "train.actors.tracks.bend_weight": "smoothness_weight",
    "train.deformable.least": "min_gaussians",
    "train.deformable.tracks.size_weight": "l2_weight",
    "train.deformable.tracks.bend_weight": "smoothness_weight",
    "train.deformable.lattice.size_weight": "l2_weight",
}
"""The new names of settings, by their old paths. The sections that they are in have kept their names."""


def current_names(
    values: Mapping[Any, Any], defaults: Callable[[], Mapping[str, Any]]
) -> tuple[dict[Any, Any], list[str]]:
    """The `values` of a config with all settings under their new names, and the old paths that it has, overrides
    included.

    config.yaml may hold a new name at its default, and a user's file over it the old name: the latter holds. `defaults`
    gives the tree of all defaults. Raises ConfigError where both are set, to different values.
    """
    current, old_paths = deepcopy(dict(values)), []
    for where, tree in settings_trees(current):
        for path, new in RENAMED.items():
            section, _, old = path.rpartition(".")
            node = subtree(tree, section)
            if node is None or old not in node:
                continue
            value, default = node.pop(old), (subtree(defaults(), f"{where}{section}") or {}).get(new)
            if node.setdefault(new, value) not in (value, default):
                raise ConfigError(
                    f"'{where}{path}' is the old name of '{where}{section}.{new}', and both are set ({value} and "
                    f"{node[new]}): drop the old one"
                )
            node[new] = value
            old_paths.append(f"{where}{path}")
    return current, old_paths


def settings_trees(values: dict[Any, Any]) -> Iterator[tuple[str, dict[Any, Any]]]:
    """The trees of settings in a config, each with the path before its keys: the config itself, and the overrides of
    datasets, methods and variants of the ablation."""
    yield "", values
    for kind in ("datasets", "methods", "ablation.without"):
        for name, entry in (subtree(values, kind) or {}).items():
            if isinstance(entry, dict) and isinstance(entry.get("overrides"), dict):
                yield f"{kind}.{name}.overrides.", entry["overrides"]


def subtree(tree: Mapping[Any, Any], path: str) -> dict[Any, Any] | None:
    """The mapping at a `path` of keys with dots, which is `tree` for an empty path; None where there is none."""
    node: Any = tree
    for key in path.split(".") if path else ():
        node = node.get(key) if isinstance(node, Mapping) else None
    return node if isinstance(node, dict) else None
