"""Settings that no longer exist, and why: a config file that still names one gets this sentence."""

from collections.abc import Mapping
from typing import Any

from drivesplat.errors import ConfigError

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


def refuse_removed(values: Mapping[str, Any], where: str = "") -> None:
    """Raises ConfigError, one line, where a tree of settings from the top level has a key of REMOVED; `where` precedes
    the key in the message."""
    for key, reason in REMOVED.items():
        *path, name = key.split(".")
        tree: Any = values
        for part in path:
            tree = tree.get(part) if isinstance(tree, Mapping) else None
        if isinstance(tree, Mapping) and name in tree:
            raise ConfigError(f"'{where}{key}' was removed: {reason}; delete it (docs/tried.csv has the measurements)")
