"""The methods of which one takes the place of the shipped `street` on a drive without boxes."""

from drivesplat.settings.method import MethodSettings, default_methods

REPLACED = "street"
"""The method that needs boxes."""
DISCOVERED, DRIFTING = "street_discovered", "drifting"
"""Those in its place, called as in presets/without_boxes.yaml."""


def substitutes() -> dict[str, MethodSettings]:
    """`street` with objects that are found in LiDAR scans, and a background in which Gaussians drift."""
    street = default_methods()[REPLACED]
    return {
        DISCOVERED: street.model_copy(update={"tracks": "discovered"}),
        DRIFTING: MethodSettings(parts=("background", "drifting"), tracks="none"),
    }


def substitute(scans: bool) -> str:
    """The name of the one that a drive without boxes gets, with or without LiDAR scans."""
    return DISCOVERED if scans else DRIFTING
