"""What the formats of other programs share: an asset as their files declare it, names of classes, and files."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivesplat.editing.assets.asset import INVENTED, Asset, extra_columns
from drivesplat.editing.assets.frames import AssetFrame
from drivesplat.errors import ResultError
from drivesplat.io.regular_file import regular_file
from drivesplat.model.splat_ply import write_splat_ply
from drivesplat.scene.object_class import ObjectClass

MAX_BYTES = 20_000_000
"""Of an index that is read."""
CLASSES = {
    "automobile": ObjectClass.CAR,
    "person": ObjectClass.PEDESTRIAN,
    "heavy_truck": ObjectClass.TRUCK,
    "train_or_tram_car": ObjectClass.TRAM,
    "other_vehicle": ObjectClass.VEHICLE,
    "trolley_bus": ObjectClass.BUS,
    "consumer_vehicle": ObjectClass.CAR,
    "consumer_vehicles": ObjectClass.CAR,
    "vru_pedestrian": ObjectClass.PEDESTRIAN,
    "vru_pedestrians": ObjectClass.PEDESTRIAN,
    **{own.value: own for own in ObjectClass},
}
"""The classes that names of Asset Harvester and SplatSim stand for, besides those of drivesplat."""


@dataclass(frozen=True, eq=False)
class ForeignAsset:
    """An asset as files of another program declare it.

    `file` has its Gaussians. `frame` is None where files declare none. `label` is their name of its class, `size` the
    length, width and height of its box in metres; None: not declared. `centred` says whether their origin is the centre
    of the box; where it is not, the origin is moved to the middle of the Gaussians.
    """

    name: str
    file: Path
    frame: AssetFrame | None = None
    label: str | None = None
    size: Float[np.ndarray, "3"] | None = None
    centred: bool = True


def class_of(label: str) -> ObjectClass | None:
    """The class that a name stands for, in any case; None for an unknown name."""
    return CLASSES.get(label.lower())


def label_of(object_class: ObjectClass) -> str:
    """The name that Asset Harvester and SplatSim have for a class."""
    return next(name for name, known in CLASSES.items() if known is object_class)


def file_inside(index: Path, named: Any) -> Path:
    """The file that an index names by its path relative to the index. Raises ResultError for a path that is none, that
    leads out of the folder of the index, or to no file."""
    folder = index.parent.resolve()
    if not isinstance(named, str) or not named:
        raise ResultError(f"{index}: {named!r} is not the path of a file")
    file = index.parent / named
    if Path(named).is_absolute() or not file.resolve().is_relative_to(folder):
        raise ResultError(f"{index}: the path {named!r} leads out of the folder of the index")
    if not file.is_file():
        raise ResultError(f"{index}: there is no {file}")
    return file


def json_of(path: Path) -> Any:
    """The content of a JSON file of a user. Raises ResultError, which names the file, where it is not one."""
    try:
        return json.loads(regular_file(path, MAX_BYTES).read_text(encoding="utf-8-sig"))
    except (OSError, RecursionError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ResultError(f"{path}: not a readable JSON file ({getattr(error, 'strerror', None) or error})") from error


def box_of(path: Path, edges: Any, what: str) -> Float[np.ndarray, "3"]:
    """Three edges in metres. Raises ResultError, which names the file and `what` they are there, for anything else."""
    try:
        box = np.array(edges, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        box = np.zeros(0)
    if box.shape != (3,) or not np.isfinite(box).all() or (box <= 0.0).any():
        raise ResultError(f"{path}: {what} {edges!r} is not three lengths in metres")
    return box


def write_gaussians(path: Path, asset: Asset, frame: AssetFrame, note: dict[str, Any]) -> None:
    """Writes the Gaussians of an asset in a frame, in the layout of 3D Gaussian Splatting, with the columns of
    asset.ply that other programs ignore: LiDAR logits, and `invented` where some are."""
    gaussians = frame.from_object(asset.gaussians)
    extra = extra_columns(gaussians, asset.invented)
    if not bool(asset.invented.any()):
        del extra[INVENTED]
    write_splat_ply(path, gaussians, {"asset": asset.name, "frame": frame.words, **note}, extra)
