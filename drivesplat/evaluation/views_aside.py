"""The views from beside the recorded path in the metrics of a method: those of a synthetic world, from metres to the
left or right, and those of cameras that training left out."""

from collections.abc import Sequence
from typing import Any

from drivesplat.evaluation.comparison import Figures
from drivesplat.scene.splits import SIDE_CAMERA

LATERAL = "lateral"
VIEW_FIGURES: Figures = {
    "static": ("static", "psnr"),
    "moving_vehicle": ("moving_vehicle", "psnr"),
    "road": ("road", "psnr"),
    "markings": ("markings", "psnr"),
    "depth_error": ("depth", "median_relative_error"),
}
"""The figures of such a view, each with its keys. A left-out camera has no error of depth, no road and no
markings."""
View = tuple[str, str]
"""The kind of a view, LATERAL or SIDE_CAMERA, and its key there: an offset to the left in metres, or a camera."""


def views_aside(results: Sequence[dict[str, Any] | None]) -> list[View]:
    """The views that any of the results of methods has: nearest first, left before right; then cameras by name."""
    lateral = {key for result in results if result for key in result.get(LATERAL) or {}}
    cameras = {key for result in results if result for key in result.get(SIDE_CAMERA) or {}}
    nearest_first = sorted(lateral, key=lambda key: (abs(float(key)), -float(key)))
    return [*((LATERAL, key) for key in nearest_first), *((SIDE_CAMERA, key) for key in sorted(cameras))]


def place_of_view(view: View) -> str:
    """Where a view is from.

    >>> place_of_view(("lateral", "-4.0")), place_of_view(("side_camera", "CAM_FRONT_LEFT"))
    ('4 m to the right', 'CAM_FRONT_LEFT')
    """
    kind, key = view
    if kind == SIDE_CAMERA:
        return key
    return f"{abs(float(key)):g} m to the {'left' if float(key) > 0 else 'right'}"
