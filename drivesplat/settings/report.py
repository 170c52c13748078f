"""Settings of the report across scenes, and of the page of a scene's films."""

from typing import Any

from drivesplat.settings import Settings
from drivesplat.settings.published import PublishedFigures

HELD_OUT_PAIR = {"recorded": "held_out_recorded.png", "rendered": "held_out_rendered.png"}
"""One held-out image, recorded and rendered, written by the evaluation of a method."""
LOOKS = {"panel": "ghost_panel.png", "with_car": "with_car.png", "without_car": "without_car.png"}
"""Further images of a method."""
LIDAR_LOOKS = {"lidar": "lidar.png"}
"""Those of a method that renders LiDAR."""
PICTURES = {**HELD_OUT_PAIR, **LOOKS, **LIDAR_LOOKS}
"""Images that the report shows of a method on a scene, and their paths in its folder."""


class ReportJob(Settings):
    """All settings that determine the report of given results."""

    expected: dict[str, dict[str, Any]]
    """For every configured scene, in order, the settings and code digests of the stages that its metrics.json should
    come from. Other results are stale."""
    reference: str | None
    """The method whose gap others close: the first without moving parts. None where there is none."""
    random_seed: int
    """Random seed of the bootstrap over scenes."""
    published: tuple[PublishedFigures, ...] = ()
    """Published figures to show beside the measured ones."""


class ShownFile(Settings):
    """A film, picture or link of a page of films."""

    path: str
    """Relative to the page."""
    words: str
    """What it shows."""
    poster: str | None = None
    """A picture of a film, relative to the page. None: its first frame."""


class FilmSection(Settings):
    """The films of a method, or of all methods together, with pictures and links."""

    title: str
    films: tuple[ShownFile, ...] = ()
    pictures: tuple[ShownFile, ...] = ()
    links: tuple[ShownFile, ...] = ()


class FilmPageJob(Settings):
    """All settings that determine the page of a scene's films."""

    scene: str
    sections: tuple[FilmSection, ...]
