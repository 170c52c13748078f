"""Label sets of segmentation networks, and the classes of class maps.

All networks write the same classes, those of Cityscapes, so that the Gaussians' logits are few and maps of two networks
can be compared. A label that fits none of them is unlabelled.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from jaxtyping import UInt8

from drivesplat.errors import ConfigError
from drivesplat.scene.masks import UNLABELLED
from drivesplat.settings.segment import LabelSetName

CLASSES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation", "terrain",
    "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
)  # fmt: skip
"""The name of each value of a class map."""
SKY = CLASSES.index("sky")
VEHICLES = ("car", "truck", "bus", "train", "motorcycle", "bicycle")
PEOPLE = ("person", "rider")

_COUNTS = {"cityscapes": (19,), "mapillary": (65, 66), "ade20k": (150,)}
"""The number of labels of the networks of each set; Mapillary's with and without `unlabeled`."""
_LABELS: dict[str, dict[str, dict[str, int]]] = {
    "cityscapes": {name: {name: number} for number, name in enumerate(CLASSES)},
    "mapillary": {
        "road": {
            "road": 13, "bike lane": 7, "crosswalk - plain": 8, "parking": 10, "service lane": 14,
            "lane marking - crosswalk": 23, "lane marking - general": 24, "catch basin": 36, "manhole": 41,
            "pothole": 43,
        },
        "sidewalk": {"sidewalk": 15, "curb": 2, "curb cut": 9, "pedestrian area": 11},
        "building": {"building": 17, "bridge": 16, "tunnel": 18},
        "wall": {"wall": 6},
        "fence": {"fence": 3, "guard rail": 4, "barrier": 5},
        "pole": {"pole": 45, "street light": 44, "traffic sign frame": 46, "utility pole": 47},
        "traffic light": {"traffic light": 48},
        "traffic sign": {"traffic sign (back)": 49, "traffic sign (front)": 50},
        "vegetation": {"vegetation": 30},
        "terrain": {"terrain": 29, "mountain": 25, "sand": 26, "snow": 28},
        "sky": {"sky": 27},
        "person": {"person": 19},
        "rider": {"bicyclist": 20, "motorcyclist": 21, "other rider": 22},
        "car": {"car": 55, "caravan": 56},
        "truck": {"truck": 61, "trailer": 60, "other vehicle": 59},
        "bus": {"bus": 54},
        "train": {"on rails": 58},
        "motorcycle": {"motorcycle": 57, "wheeled slow": 62},
        "bicycle": {"bicycle": 52},
    },
    "ade20k": {
        "road": {"road": 6, "runway": 54, "dirt track": 91},
        "sidewalk": {"sidewalk": 11, "path": 52, "stairs": 53, "stairway": 59, "step": 121},
        "building": {
            "building": 1, "house": 25, "skyscraper": 48, "hovel": 79, "tower": 84, "windowpane": 8, "door": 14,
            "awning": 86, "booth": 88, "bridge": 61,
        },
        "wall": {"wall": 0},
        "fence": {"fence": 32, "railing": 38, "bannister": 95},
        "pole": {"pole": 93, "streetlight": 87},
        "traffic light": {"traffic light": 136},
        "traffic sign": {"signboard": 43},
        "vegetation": {"tree": 4, "plant": 17, "flower": 66, "palm": 72},
        "terrain": {
            "grass": 9, "earth": 13, "mountain": 16, "field": 29, "rock": 34, "sand": 46, "hill": 68, "land": 94,
        },
        "sky": {"sky": 2},
        "person": {"person": 12},
        "car": {"car": 20, "van": 102},
        "truck": {"truck": 83},
        "bus": {"bus": 80},
        "motorcycle": {"minibike": 116},
        "bicycle": {"bicycle": 127},
    },
}  # fmt: skip
"""The numbers of labels by set, class and name, of all labels that have a class. A more detailed label of Mapillary
Vistas 2.0 ('traffic light - general') has the class of its first part."""
_NAMED = {label: name for of_set in _LABELS.values() for name, labels in of_set.items() for label in labels} | {
    "lane marking": "road", "crosswalk": "road", "traffic sign": "traffic sign", "motorbike": "motorcycle"
}  # fmt: skip


@dataclass(frozen=True)
class LabelSet:
    """The labels of a network: the `name` of their set, 'own' where they are known by their names alone; `classes` (n,)
    uint8, the value in class maps of each label, UNLABELLED where it has none."""

    name: str
    classes: UInt8[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.classes)


def label_set(
    model: str, count: int, names: Sequence[str] | None = None, wanted: LabelSetName | None = None
) -> LabelSet:
    """The label set of a `model` with `count` labels: the one that is `wanted`, else by the `names` of its labels, else
    by their number. Raises ConfigError where none fits, or no label is the sky."""
    table = np.full(count, UNLABELLED, dtype=np.uint8)
    named = None if names is None else [class_of(name) for name in names]
    found = wanted or next((name for name, counts in _COUNTS.items() if count in counts), None)
    if wanted is not None and count not in _COUNTS[wanted]:
        raise ConfigError(
            f"segment.labels: {wanted} has {_either(_COUNTS[wanted])} labels, and {model} has {count}; name another "
            f"label set ({', '.join(get_args(LabelSetName))})"
        )
    if wanted is None and named is not None and "sky" in named:
        table[:] = [UNLABELLED if name is None else CLASSES.index(name) for name in named]
        return LabelSet("own", table)
    if found is None:
        raise ConfigError(
            f"segment.model: {model} has {count} labels, none of them called sky; known label sets are "
            + ", ".join(f"{name} ({_either(counts)})" for name, counts in _COUNTS.items())
        )
    for name, labels in _LABELS[found].items():
        table[list(labels.values())] = CLASSES.index(name)
    return LabelSet(found, table)


def class_of(label: str) -> str | None:
    """The class of a label by its name in any of the sets; None where it has none.

    >>> class_of("Sky"), class_of("building, edifice"), class_of("Traffic Light - General (Upright)"), class_of("sofa")
    ('sky', 'building', 'traffic light', None)
    """
    name = label.lower().replace("_", " ").replace(";", ",").partition(",")[0].strip()
    return _NAMED.get(name) or _NAMED.get(name.partition(" - ")[0].partition(" (")[0].strip())


def class_numbers(names: Iterable[str]) -> list[int]:
    """The values in class maps of classes by name."""
    return [CLASSES.index(name) for name in names]


def _either(counts: Sequence[int]) -> str:
    return " or ".join(map(str, counts))
