"""What the index of a library says of an asset."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.editing.assets.asset import SCHEMA, TURNTABLE, VISIBLE
from drivesplat.editing.assets.formats.foreign import json_of
from drivesplat.errors import ResultError
from drivesplat.scene.object_class import ObjectClass
from drivesplat.settings.asset_references import RECORD

THUMBNAIL = "thumbnail.webp"
"""A small picture of an asset, beside its other files."""
SIDES = 360


@dataclass(frozen=True)
class LibraryEntry:
    """An asset of a library.

    `size` are length, width and height in metres. `psnr` (dB) is that of its pixels in held-out images, weighted by
    their number; None: not measured. `seen` is the fraction of its sides that cameras saw; None: unknown. `invented` is
    the fraction of Gaussians of sides that none saw. `thumbnail` and `turntable` are paths relative to the library.
    """

    id: str
    object_class: ObjectClass
    category: str
    size: tuple[float, float, float]
    gaussians: int
    sh_degree: int
    invented: float
    seen: float | None
    psnr: float | None
    lidar: bool
    walks: bool
    mean_color: tuple[float, float, float]
    source: Mapping[str, str]
    thumbnail: str | None
    turntable: str | None

    @property
    def origin(self) -> str:
        """Where it comes from, in words."""
        words = (f"{key} {value}" for key, value in self.source.items() if key != "sha256" and value)
        return ", ".join(words)

    def record(self) -> dict[str, Any]:
        """The entry as plain data."""
        plain = {name: value for name, value in vars(self).items() if name not in ("object_class", "source")}
        return {**plain, "class": self.object_class.value, "source": dict(self.source)}


def read_entry(folder: Path) -> LibraryEntry:
    """The entry of the asset in a folder, without its Gaussians. Figures that a record by hand lacks are 0 or None.

    Raises ResultError, which names the file, for a record that is none of an asset, or of another version.
    """
    record = json_of(folder / RECORD)
    schema = record.get("schema") if isinstance(record, dict) else None
    if schema != SCHEMA:
        raise ResultError(f"{folder / RECORD}: its schema is {schema!r}, not {SCHEMA}; make the asset again")
    try:
        return _entry(folder, record)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise ResultError(f"{folder / RECORD}: not the record of an asset ({error})") from error


def _entry(folder: Path, record: Mapping[str, Any]) -> LibraryEntry:
    size, color = (tuple(float(value) for value in record.get(key) or (0, 0, 0)) for key in ("size", "mean_color"))
    count = int(record.get("gaussians", 0))
    if len(size) != 3 or len(color) != 3:
        raise ValueError("its size or its mean colour is not three numbers")
    thumbnail, turntable = (
        f"{folder.name}/{file}" if (folder / file).is_file() else None for file in (THUMBNAIL, TURNTABLE)
    )
    return LibraryEntry(
        id=folder.name,
        object_class=ObjectClass(record["class"]),
        category=str(record["category"]),
        size=size,
        gaussians=count,
        sh_degree=int(record.get("sh_degree", 0)),
        invented=round(int(record.get("invented", 0)) / max(count, 1), 4),
        seen=seen_fraction(np.array(record["seen"], dtype=np.float64).reshape(-1)),
        psnr=mean_psnr(record["quality"]),
        lidar=record.get("lidar") is not None,
        walks=record["gait"] is not None,
        mean_color=color,
        source={str(key): str(value) for key, value in record["source"].items()},
        thumbnail=thumbnail,
        turntable=turntable,
    )


def seen_fraction(seen: np.ndarray) -> float | None:
    """The fraction of an object's sides that face one of the directions `seen` (s,), radians; None without any."""
    if not len(seen):
        return None
    facing = np.arange(SIDES) * (2.0 * np.pi / SIDES)
    return round(float((np.cos(facing[:, None] - seen).max(axis=1) >= np.cos(VISIBLE)).mean()), 3)


def mean_psnr(quality: Mapping[str, Any]) -> float | None:
    """The PSNR of an object in all groups of held-out images, weighted by the number of images; None without one."""
    groups = [own for own in quality.values() if isinstance(own, dict) and own.get("psnr") is not None]
    images = sum(own["images"] for own in groups)
    return round(float(sum(own["psnr"] * own["images"] for own in groups) / images), 2) if images else None
