"""Both names of an object's class, as `Track` and `Box` take them."""

from drivesplat.readers.nuscenes.object_classes import object_class
from drivesplat.scene.object_class import ObjectClass


def classed(category: str) -> tuple[ObjectClass, str]:
    """The class of a nuScenes category, and the category itself."""
    return object_class(category), category
