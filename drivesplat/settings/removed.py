"""Settings that no longer exist, and why: a config file that sets one gets this sentence.

config.yaml had every setting until the last version. In a file that was made from it, a removed setting at its former
default says nothing: in this version it is left out, with a note.
"""

from collections.abc import Callable, Mapping
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.settings.renamed import RENAMED, current_names, settings_trees, subtree

REMOVED = {
    "free_space": "fading Gaussians in space that LiDAR rays prove empty improved no measurement",
    "train.floaters.free_space": "fading Gaussians in space that LiDAR rays prove empty improved no measurement",
    "train.camera_poses": "camera poses learned in training improved no measurement and took a third more time; "
    "refine_poses corrects poses",
    "train.actors.mirrored": "mirrored vehicles cost quality on recorded drives; train.deformable.mirrored stays",
    "train.actors.mirrored_images": "vehicles are not mirrored any more; train.deformable.mirrored_images stays",
    "train.deformable.field": "lattices deform people; the network was never measured to be better",
    "train.deformable.network": "lattices deform people; the network was never measured to be better",
    "train.deformable.out_of_box_weight": "the term had no effect",
    "train.drifting.opacity_weight": "the term cost quality",
    "train.entropy_every": "every iteration with an image has the term of train.entropy_weight; fewer cost quality",
    "train.mcmc.growth": "the number of Gaussians grows by 0.05 at a time; more saved no time",
    "train.default.absgrad": "it was never measured to be better",
}
"""Reasons by key, dotted from the top level of the config. docs/tried.csv has the measurements."""


FORMER_DEFAULTS = {
    "free_space": {
        "triangulated": True, "voxel": 0.3, "range": 30.0, "margin": 0.3, "margin_share": 0.02, "min_rays": 3,
    },
    "train.floaters.free_space": False,
    "train.camera_poses": {
        "corrected": False, "max_shift": 0.05, "max_turn": 0.3, "learning_rate": 0.002, "size_weight": 0.001,
        "bend_weight": 0.01,
    },
    "train.actors.mirrored": 0.0,
    "train.actors.mirrored_images": 30,
    "train.deformable.field": "lattice",
    "train.deformable.network": {
        "layers": 8, "width": 256, "frequencies": 10, "embedding": 16, "learning_rate": 0.0005,
    },
    "train.deformable.out_of_box_weight": 0.0,
    "train.drifting.opacity_weight": 0.0,
    "train.entropy_every": 1,
    "train.mcmc.growth": 0.05,
    "train.default.absgrad": False,
}  # fmt: skip


def in_this_version(
    values: Mapping[Any, Any], defaults: Callable[[], Mapping[str, Any]]
) -> tuple[dict[Any, Any], list[str]]:
    """The values of a config in the names of this version, without removed settings at their former defaults, and a
    note for each kind of setting that the next version will refuse; `defaults` as in `current_names`. Raises
    ConfigError for other removed settings."""
    current, old_paths = current_names(values, defaults)
    dropped = []
    for where, tree in settings_trees(current):
        for key, default in FORMER_DEFAULTS.items():
            section, _, name = key.rpartition(".")
            node = subtree(tree, section)
            if node is None or name not in node:
                continue
            value, of_section = node[name], isinstance(node[name], dict) and isinstance(default, dict)
            if value == default or (of_section and value.items() <= default.items()):
                del node[name]
                dropped.append(where + key)
        refuse_removed(tree, where)
    notes = []
    if old_paths:
        now = ", ".join(f"{old} (now {next(n for o, n in RENAMED.items() if old.endswith(o))})" for old in old_paths)
        notes.append(f"old names of settings, which the next version will refuse: {now}")
    if dropped:
        notes.append(f"removed settings, which the next version will refuse: {', '.join(dropped)}")
    return current, notes


def refuse_removed(values: Mapping[str, Any], where: str = "") -> None:
    """Raises ConfigError, one line, where a tree of settings from the top level has a key of REMOVED; `where` precedes
    the key in the message."""
    for key, reason in REMOVED.items():
        section, _, name = key.rpartition(".")
        if name in (subtree(values, section) or {}):
            raise ConfigError(f"'{where}{key}' was removed: {reason}; delete it (docs/tried.csv has the measurements)")
