"""Images of measured methods for the page, and files that it links to."""

import base64
import io
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from drivesplat.errors import ResultError
from drivesplat.provenance.file_digests import checked_digest
from drivesplat.settings.report import PICTURES

MAX_WIDTH = 1280
"""Pixels; wider images are reduced."""
QUALITY = 85
COMPARISON_SIZE = 100
"""Columns and rows at which two images are compared."""


@dataclass
class MethodMedia:
    """Of a method on a scene: `images` by their keys in PICTURES, and `links`, paths relative to the results folder."""

    images: dict[str, Path] = field(default_factory=dict)
    links: list[str] = field(default_factory=list)


def collect_media(files: Iterable[str | Path], results: Path) -> dict[tuple[str, str], MethodMedia]:
    """The media of every scene and method among `files` in {results}/{scene}/{method}/, those of the scene itself
    under the method ''."""
    names, found = {name: key for key, name in PICTURES.items()}, {}
    for file in map(Path, files):
        scene, *inner = file.relative_to(results).parts
        method, inner = (inner[0], inner[1:]) if len(inner) > 1 else ("", inner)
        own = found.setdefault((scene, method), MethodMedia())
        key = names.get("/".join(inner))
        if key:
            own.images[key] = file
        else:
            own.links.append(file.relative_to(results).as_posix())
    return found


def read_image(path: Path) -> Image.Image:
    """An image in RGB. Raises ResultError naming the path if it cannot be read."""
    try:
        checked_digest(path, warn=False)
        with Image.open(path) as image:
            return image.convert("RGB")
    except OSError as error:
        raise ResultError(f"{path} is not a readable image ({error}); delete it and rerun") from error


def difference_position(first: Image.Image, second: Image.Image) -> float:
    """The horizontal position in [0, 1] at which two images of one view differ: the centroid of the squared difference;
    0.5 for equal images."""
    a, b = (
        np.asarray(picture.resize((COMPARISON_SIZE, COMPARISON_SIZE)), dtype=np.float64) for picture in (first, second)
    )
    weights = ((a - b) ** 2).sum(axis=(0, 2))
    places = (np.arange(COMPARISON_SIZE) + 0.5) / COMPARISON_SIZE
    return float(np.average(places, weights=weights)) if weights.any() else 0.5


def data_url(picture: Image.Image) -> str:
    """An RGB image as a JPEG data URL."""
    reduced = picture.copy()
    reduced.thumbnail((MAX_WIDTH, reduced.height), Image.Resampling.LANCZOS)
    written = io.BytesIO()
    reduced.save(written, format="JPEG", quality=QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(written.getvalue()).decode()
