"""Settings of the rule `discover`."""

from drivesplat.settings import Settings


class DiscoverSettings(Settings):
    """Moving objects found in LiDAR scans, without labels. docs/without_boxes.md"""

    lidar: str | None = None
    """The LiDAR whose scans are searched. null = the one with the most returns."""


class DiscoverJob(Settings):
    """All settings that determine the discovered tracks of one scene."""

    discover: DiscoverSettings
