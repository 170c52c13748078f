"""The content of own_car.json: the image regions that show the body of the ego vehicle.

    cameras         all cameras of the scene, by name
        source      'polygons' (given by the user), 'images' (detected), null: no body is known in this camera
        outlines    lists of corners x, y in fractions of the image's width and height, one outline per camera if given
                    by masks.own_car_polygons
        share       fraction of the image that the outlines enclose
        why_null    the reason for a source of null
    provenance

The stage `own_car` writes it (`drivesplat.preprocess.ego_mask`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from drivesplat.io.storage import Provenance, read_json, unreadable

RULE = "own_car"
Outline = tuple[tuple[float, float], ...]
"""Corners x, y."""


@dataclass(frozen=True)
class EgoMask:
    """The body of the ego vehicle in the images of each camera that sees it: `outlines` in fractions of width and
    height, and their `source`, 'polygons' or 'images'."""

    outlines: Mapping[str, tuple[Outline, ...]] = field(default_factory=dict)
    source: Mapping[str, str] = field(default_factory=dict)

    def pixels(self, camera: str, size: tuple[int, int]) -> np.ndarray:
        """The pixels (h, w) bool that show the body in an image of `camera` at `size` (width, height)."""
        return enclosed(self.outlines.get(camera, ()), size)


NO_EGO_MASK = EgoMask()


def enclosed(outlines: tuple[Outline, ...], size: tuple[int, int]) -> np.ndarray:
    """The pixels (h, w) bool within any of the outlines, which are in fractions of `size` (width, height)."""
    pixels = np.zeros((size[1], size[0]), dtype=np.uint8)
    for outline in outlines:
        cv2.fillPoly(pixels, [np.round(np.array(outline) * size).astype(np.int32)], 1)
    return pixels.astype(bool)


def read_ego_mask(path: str | Path) -> tuple[EgoMask, Provenance]:
    """Reads own_car.json; returns the masks and the provenance. Raises ResultError that names the file and its rule if
    it is invalid."""
    content = read_json(path, RULE)
    try:
        known = {name: camera for name, camera in content["cameras"].items() if camera["source"]}
        outlines = {
            name: tuple(tuple((float(x), float(y)) for x, y in outline) for outline in camera["outlines"])
            for name, camera in known.items()
        }
        return EgoMask(outlines, {name: camera["source"] for name, camera in known.items()}), content["provenance"]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(path, RULE, f"not a record of the ego vehicle's mask ({error})") from error
