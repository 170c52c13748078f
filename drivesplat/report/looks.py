"""What there is to see of measured methods: pictures for the page, and files that it links to."""

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

WIDEST = 1280
"""Pixels to which wider pictures are reduced."""
QUALITY = 85
COMPARED = 100
"""Columns and rows of pictures that are compared."""


@dataclass
class Looks:
    """Of a method on a scene: pictures by their names in PICTURES, and `links`, paths from the results folder."""

    pictures: dict[str, Path] = field(default_factory=dict)
    links: list[str] = field(default_factory=list)


def looks_of(files: Iterable[str | Path], results: Path) -> dict[tuple[str, str], Looks]:
    """What there is of every scene and method among `files`, which lie in {results}/{scene}/{method}/."""
    names, found = {name: key for key, name in PICTURES.items()}, {}
    for file in map(Path, files):
        scene, method, *inner = file.relative_to(results).parts
        own = found.setdefault((scene, method), Looks())
        key = names.get("/".join(inner))
        if key:
            own.pictures[key] = file
        else:
            own.links.append(file.relative_to(results).as_posix())
    return found


def picture_of(path: Path) -> Image.Image:
    """A picture in RGB. Raises ResultError naming the path where it cannot be read."""
    try:
        checked_digest(path, warn=False)
        with Image.open(path) as image:
            return image.convert("RGB")
    except OSError as error:
        raise ResultError(f"{path} is no readable picture ({error}); delete it, and its rule makes it again") from error


def apart_at(first: Image.Image, second: Image.Image) -> float:
    """How far across, of 1, two pictures of one view differ: the mean over what they differ by, squared; 0.5 where they
    do not."""
    a, b = (np.asarray(picture.resize((COMPARED, COMPARED)), dtype=np.float64) for picture in (first, second))
    weights = ((a - b) ** 2).sum(axis=(0, 2))
    places = (np.arange(COMPARED) + 0.5) / COMPARED
    return float(np.average(places, weights=weights)) if weights.any() else 0.5


def data_address(path: Path) -> str:
    """A picture as an address that holds it, a JPEG. Raises ResultError naming the path where it cannot be read."""
    return address_of(picture_of(path))


def address_of(picture: Image.Image) -> str:
    """An RGB picture as an address that holds it, a JPEG."""
    reduced = picture.copy()
    reduced.thumbnail((WIDEST, WIDEST), Image.Resampling.LANCZOS)
    written = io.BytesIO()
    reduced.save(written, format="JPEG", quality=QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(written.getvalue()).decode()
