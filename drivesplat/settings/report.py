"""What the report across scenes is told."""

from typing import Any

from drivesplat.settings import Settings

HELD_OUT_PAIR = {"recorded": "held_out_recorded.png", "rendered": "held_out_rendered.png"}
"""A held-out image as it was recorded and as a method renders it, which come with the method's figures."""
LOOKS = {"panel": "ghost_panel.png", "with_car": "with_car.png", "without_car": "without_car.png"}
"""Further pictures of a method."""
PICTURES = {**HELD_OUT_PAIR, **LOOKS}
"""What the page shows of a method on a scene, and where it lies in its folder."""


class ReportJob(Settings):
    """Everything that decides the report of given results."""

    expected: dict[str, dict[str, Any]]
    """For every configured scene, in order, the settings and code of the stages that its metrics.json should come
    from: what else is stale."""
    reference: str | None
    """The method whose gap others close: the first without parts that move. None where there is no such method."""
    random_seed: int
    """Seeds the resampling of scenes."""
