"""The classes of objects in settings."""

from typing import Literal

ObjectClassName = Literal[
    "car", "truck", "bus", "trailer", "construction_vehicle", "tram", "vehicle", "motorcycle", "bicycle", "rider",
    "pedestrian", "animal", "other_movable",
]  # fmt: skip
"""The values of `drivesplat.scene.object_class.ObjectClass`."""
