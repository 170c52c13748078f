"""Pictures and captions of renderings beside the truth, for films."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import colormaps

from drivesplat.errors import ResultError
from drivesplat.rendering.panels import Panels
from drivesplat.settings.render import FilmEncoding

MAX_ERROR = 0.5
"""The absolute error, of colours in [0, 1], that is drawn brightest."""


def finite_image(image: Float[np.ndarray, "h w 3"], method: str) -> Float[np.ndarray, "h w 3"]:
    """A rendering clamped to [0, 1]. Raises ResultError that names the method where it contains NaN or Inf."""
    if not np.isfinite(image).all():
        raise ResultError(f"a rendering of {method} contains NaN or Inf; delete its checkpoint.npz and rerun")
    return image.clip(0.0, 1.0)


def with_psnr(name: str, found: dict[str, Any] | None) -> str:
    """A method with the PSNR of its image, a record of `drivesplat.evaluation.metrics.psnr_record`."""
    if found is None:
        return name
    return f"{name}, identical" if found["psnr"] is None else f"{name}, {found['psnr']:.1f} dB"


def panel_pictures(
    truth: Float[np.ndarray, "h w 3"], *renderings: Float[np.ndarray, "h w 3"], panels: Panels
) -> list[UInt8[np.ndarray, "y x 3"]]:
    """Pictures of the size of a panel from images in [0, 1]: the truth, the renderings, and the mean absolute error of
    the last one over the channels, from black to bright at MAX_ERROR."""
    error = colormaps["inferno"](np.abs(renderings[-1] - truth).mean(axis=2) / MAX_ERROR)[..., :3]
    width, height = panels.size
    return [(image[:height, :width] * 255.0 + 0.5).astype(np.uint8) for image in (truth, *renderings, error)]


def film_record(
    camera: str, encoding: FilmEncoding, panels: Panels, figures: Sequence[dict[str, Any]], written: dict[str, Any]
) -> dict[str, Any]:
    """The JSON beside a film, without provenance: its camera and panels, the `figures` of each frame, and what
    `encode_film` has `written`."""
    return {
        "schema": 1,
        "camera": camera,
        "fps": encoding.fps,
        "frames": len(figures),
        "film": panels.record(),
        "images": list(figures),
        **written,
    }


def even_size(size: tuple[int, int]) -> tuple[int, int]:
    """Width and height (pixels) rounded down to even numbers, as films need them."""
    width, height = size
    return max(2, width // 2 * 2), max(2, height // 2 * 2)


def film_rate(timestamps: Sequence[int] | np.ndarray) -> int:
    """Recordings a second at these times in microseconds, rounded, at least 1."""
    return max(1, round(1e6 / float(np.median(np.diff(timestamps))))) if len(timestamps) > 1 else 1
