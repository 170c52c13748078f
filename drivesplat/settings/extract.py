"""What the stage `extract` may be told."""

from typing import Literal

from drivesplat.settings import Settings

OnMissing = Literal["stop", "warn"]


class ExtractSettings(Settings):
    on_missing: OnMissing = "stop"
    """A missing or corrupt image, of a key frame or between two: 'stop' names it and fails; 'warn' leaves it out and
    counts it."""


class SceneSource(Settings):
    """Everything that decides the content of one scene.json, dataroot aside."""

    dataset: str
    reader: str
    version: str
    scene: str
    frames: tuple[int, int] | None
    cameras: tuple[str, ...]
    sweeps: bool
    lidar_sweeps: bool = False
    on_missing: OnMissing
