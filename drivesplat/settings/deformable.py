"""Settings of the deformation of people, animals and cyclists."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, field_validator

from drivesplat.settings import Settings
from drivesplat.settings.object_classes import ObjectClassName

Nodes = Annotated[int, Field(ge=2, le=64)]
Stride = Annotated[float, Field(gt=0, le=20)]
STRIDES: dict[ObjectClassName, float] = {"pedestrian": 0.83, "animal": 1.2, "bicycle": 3.0, "rider": 3.0}


class GaitSettings(Settings):
    """The phase of a gait, which advances with the distance walked."""

    strides: dict[ObjectClassName, Stride] = STRIDES
    """Initial length of a cycle by class, in heights of the box: two steps of a person (0.413 to 0.415 heights each, as
    pedometers take them), a turn of a bicycle's crank. Classes that are not named have that of a pedestrian."""
    harmonics: int = Field(2, ge=1, le=8)
    """Number of multiples of the phase that deform the object, a cosine and a sine each."""
    lr_stride: float = Field(5e-4, gt=0)
    """Learning rate of the logarithm of a cycle's length."""
    lr_phase: float = Field(1e-3, gt=0)
    """Learning rate of corrections of the phase (cycles) along the path."""
    weight: float = Field(0.01, ge=0)
    """Loss weight of the mean square of both."""

    @field_validator("strides", mode="before")
    @classmethod
    def _laid_over_the_defaults(cls, value: Any) -> Any:
        return {**STRIDES, **value} if isinstance(value, Mapping) else value

    def stride_of(self, object_class: str) -> float:
        """The initial length of a cycle of a class, in heights of the box."""
        known: dict[str, float] = {**self.strides}
        return known.get(object_class, known["pedestrian"])


class LatticeSettings(Settings):
    """Displacements and rotations at the nodes of a lattice in each box."""

    nodes: tuple[Nodes, Nodes, Nodes] = (3, 8, 12)
    """Nodes along the length, width and height of the box."""
    learning_rate: float = Field(2e-3, gt=0)
    """Learning rate of displacements (metres) and rotations (radians)."""
    l2_weight: float = Field(0.1, ge=0)
    """Loss weight of the mean square of an object's displacements and rotations, times the square of the multiple of
    the phase. It is divided by the number of training images: with fewer images objects deform less."""
    smoothness_weight: float = Field(1.0, ge=0)
    """Loss weight of the mean squared difference between neighbouring nodes of an object. It is divided by the number
    of training images, too."""

    def for_scene(self, objects: int, views: int) -> "LatticeSettings":
        """The settings with the weights of means over so many `objects`, in a scene of so many training `views`."""
        weights = {name: getattr(self, name) * objects / max(1, views) for name in ("l2_weight", "smoothness_weight")}
        return self.model_copy(update=weights)
