"""Settings of the rule `extract`."""

from typing import Literal

from drivesplat.settings import Settings

OnMissing = Literal["stop", "warn"]


class ExtractSettings(Settings):
    on_missing: OnMissing = "stop"
    """Action for a missing or corrupt image: 'stop' fails and names it; 'warn' leaves it out and counts it."""


class SceneSource(Settings):
    """All settings that determine one scene.json, except the dataroot."""

    dataset: str
    reader: str
    version: str
    scene: str
    frames: tuple[int, int] | None
    cameras: tuple[str, ...]
    sweeps: bool
    lidar_sweeps: bool = False
    on_missing: OnMissing
