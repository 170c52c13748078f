"""The methods of which one takes the place of the shipped `street` on a drive without boxes."""

from collections.abc import Collection

from drivesplat.settings.method import MethodSettings, default_methods

REPLACED = "street"
"""The method that needs boxes."""
DISCOVERED, DRIFTING = "street_discovered", "drifting"
"""Those in its place, called as in presets/without_boxes.yaml."""
REASONS = {
    DISCOVERED: ("no boxes", "its objects are found in LiDAR scans"),
    DRIFTING: ("neither boxes nor LiDAR sweeps with known beams", "it takes images alone"),
}
"""What a drive lacks that gets one of them, and how this method does without."""
HOW = "docs/without_boxes.md"


def substitutes() -> dict[str, MethodSettings]:
    """`street` with objects that are found in LiDAR scans, and a background in which Gaussians drift."""
    street = default_methods()[REPLACED]
    return {
        DISCOVERED: street.model_copy(update={"tracks": "discovered"}),
        DRIFTING: MethodSettings(parts=("background", "drifting"), tracks="none"),
    }


def substitute(sweeps: int, without_beams: Collection[str]) -> str:
    """The name of the one for a drive without boxes, by its number of LiDAR sweeps and the LiDARs whose beams are
    unknown: scans need the beams of all."""
    return DISCOVERED if sweeps and not without_beams else DRIFTING


def reason(method: str) -> str:
    """Why one of them is taken, to follow the name of a drive and 'has' or 'have'."""
    lacks, how = REASONS[method]
    return f"{lacks}: {method} takes the place of {REPLACED}, since {how}"
