"""The mask files of a scene: region labels, sky and semantic classes of every image."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.io.storage import Provenance, no_provenance, read_json, unreadable
from drivesplat.io.typed_record import typed_record
from drivesplat.scene.images import read_mask
from drivesplat.settings.tracks import OTHER_TRACKS

UNLABELLED = 255
"""The value of pixels that have no class in the user's label image."""


def _rule(folder: Path) -> str:
    """The rule that writes the masks in a folder."""
    return "regions" if folder.parent.name in OTHER_TRACKS else "masks"


def mask_name(kind: str, camera: str, timestamp: int) -> str:
    """The path of a mask below the masks folder; `kind` is 'regions', 'sky' or 'semantic'."""
    return f"{kind}/{camera}/{timestamp}.png"


@dataclass(frozen=True)
class MasksRecord:
    """The content of masks.json: the `labels` of regions, the number of `images`, whether regions come from 'boxes' or
    'masks' and the sky from a 'heuristic' (in images with a class map of the dataset: from that) or 'masks', the mean
    share of sky pixels, whether any sky was found, the number of semantic classes (0: none), the source of the ego mask
    by camera that sees the ego vehicle, and whether the visibility of boxes is 'annotated' or 'estimated' (None where
    no box makes a region)."""

    labels: dict[str, int]
    images: int
    regions: str
    sky: str
    sky_share: float
    sky_known: bool
    semantic_classes: int
    own_car: dict[str, str]
    visibility: str | None
    provenance: Provenance = field(default_factory=no_provenance)


NO_MASKS = MasksRecord({}, 0, "boxes", "heuristic", 0.0, False, 0, {}, None)
"""The record of a scene without images."""


def read_masks_record(folder: Path) -> MasksRecord:
    """Reads masks.json. Raises ResultError that names the file and its rule if it is invalid."""
    path = folder / "masks.json"
    content = read_json(path, _rule(folder))
    try:
        return typed_record(MasksRecord, content)
    except ValueError as error:
        raise unreadable(path, _rule(folder), f"not a record of masks ({error})") from error


def read_sky_mask(folder: Path, camera: str, timestamp: int, size: tuple[int, int]) -> np.ndarray:
    """The sky (h, w) bool of an image at `size` (width, height).

    Raises ResultError if the mask is missing or unreadable.
    """
    return _made_mask(folder, "sky", camera, timestamp, size) > 127


def read_labels(folder: Path, camera: str, timestamp: int, size: tuple[int, int]) -> np.ndarray:
    """The label image (h, w) of an image at `size` (width, height).

    Raises ResultError if it is missing or unreadable.
    """
    return _made_mask(folder, "regions", camera, timestamp, size)


def read_classes(folder: Path, camera: str, timestamp: int, size: tuple[int, int]) -> np.ndarray:
    """The user's classes (h, w) of an image at `size` (width, height), UNLABELLED for pixels without one.

    Raises ResultError if they are missing or unreadable.
    """
    return _made_mask(folder, "semantic", camera, timestamp, size)


def _made_mask(folder: Path, kind: str, camera: str, timestamp: int, size: tuple[int, int]) -> np.ndarray:
    path = folder / mask_name(kind, camera, timestamp)
    try:
        return read_mask(path, size)
    except DatasetError as error:
        raise unreadable(path, _rule(folder), str(error), delete=folder / "masks.json") from error
