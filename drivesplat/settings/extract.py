"""Settings of the rule `extract`."""

from typing import Literal

from drivesplat.settings import Settings

OnMissing = Literal["stop", "warn"]


class ExtractSettings(Settings):
    on_missing: OnMissing = "stop"
    """:printed: Action for a missing or corrupt image: 'stop' fails and names it; 'warn' leaves it out and counts
    it."""


class SceneSource(Settings):
    """All settings that determine one scene.json, except the dataroot.

    A reader reads `scene` of `version`: the images of `cameras` and the LiDAR sweeps at key frames; with `sweeps` also
    the images between them, with `lidar_sweeps` also the LiDAR sweeps between them. `frames` = (first, last + 1) keeps
    these key frames, renumbered from 0, and the recordings between them. `poses_from_images`: whether the poses of a
    drive without any are estimated from its images afterwards. The stage applies `dataset` and `on_missing`.
    """

    dataset: str
    reader: str
    version: str
    scene: str
    frames: tuple[int, int] | None
    cameras: tuple[str, ...]
    sweeps: bool
    lidar_sweeps: bool = False
    poses_from_images: bool = False
    on_missing: OnMissing
