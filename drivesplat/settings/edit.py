"""Edits of a recorded drive: who moves otherwise, and from where it is watched.

Metres, degrees, m/s; seconds since the scene's first image, which are seconds of the film.
"""

from collections.abc import Callable
from typing import Annotated, Any, ClassVar

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    model_serializer,
    model_validator,
)

from drivesplat.settings import Settings


def _in_quotes(value: Any) -> Any:
    if isinstance(value, bool | int | float):
        raise ValueError("an id is text: put it in quotes as it stands in tracks.csv")
    return value


Id = Annotated[str, Field(min_length=1), BeforeValidator(_in_quotes)]
"""A track's id from tracks.csv, a beginning of it that no other track has, or the name of a duplicate."""


class Gradual(Settings):
    """A change that may come in smoothly."""

    USUAL: ClassVar[float] = 0.0
    """The duration where only a start is given."""

    start: float | None = Field(None, ge=0)
    """The second at which the change begins. null = it holds from the beginning."""
    duration: float | None = Field(None, ge=0)
    """How many seconds the change takes; 0: none, it jumps."""

    @model_validator(mode="after")
    def _a_duration_has_a_start(self) -> "Gradual":
        if self.duration is not None and self.start is None:
            raise ValueError("'duration' without 'start': say at which second the change begins")
        return self


class Remove(Settings):
    """The track is not there."""

    track: Id


class Speed(Gradual):
    """The track drives its way faster or slower; without `start` from when it is first there."""

    USUAL: ClassVar[float] = 1.0

    track: Id
    factor: float | None = Field(None, gt=0, le=10)
    """Times its speed at the same place of its way."""
    to: float | None = Field(None, gt=0, le=100)
    """Its speed, whatever it was."""

    @model_validator(mode="after")
    def _factor_or_to(self) -> "Speed":
        if (self.factor is None) == (self.to is None):
            raise ValueError("give either 'factor' or 'to' (m/s)")
        return self


class Stop(Settings):
    """The track comes to rest on its way, and stays there."""

    track: Id
    at: float = Field(ge=0)
    """The second at which it begins to brake."""
    duration: float = Field(2.0, ge=0)
    """How many seconds it brakes."""


class Reverse(Settings):
    """The track drives its way backwards: from where it is last to where it is first."""

    track: Id
    turn: bool = False
    """Whether it is turned round, so that it faces where it drives."""


class Shift(Gradual):
    """The track moves out of its way."""

    USUAL: ClassVar[float] = 3.0

    track: Id
    lateral: float = Field(0.0, ge=-50, le=50)
    """Metres to its left."""
    longitudinal: float = Field(0.0, ge=-200, le=200)
    """Metres further on along its way."""
    yaw: float = Field(0.0, ge=-360, le=360)
    """Degrees to its left, about its own vertical axis."""

    @model_validator(mode="after")
    def _shifts(self) -> "Shift":
        if not (self.lateral or self.longitudinal or self.yaw):
            raise ValueError("give at least one of 'lateral', 'longitudinal' and 'yaw'")
        return self


class Swap(Settings):
    """Two tracks drive each other's way."""

    model_config = ConfigDict(serialize_by_alias=True)

    track: Id
    other: Id = Field(alias="with")


class Duplicate(Settings):
    """A copy of a track and of what it does so far, which later steps may name."""

    model_config = ConfigDict(serialize_by_alias=True)

    track: Id
    name: Id = Field(alias="as")
    """The copy's id: letters, digits, '_', '-' and '.'."""
    longitudinal: float = Field(0.0, ge=-200, le=200)
    """Metres further on along the way."""
    lateral: float = Field(0.0, ge=-50, le=50)
    """Metres to the left of the original."""
    delay: float = Field(0.0, ge=-60, le=60)
    """Seconds by which the copy does everything later."""


class Rescale(Settings):
    """The track is larger or smaller, standing where it stood."""

    track: Id
    factor: float = Field(ge=0.1, le=10)


class Ego(Gradual):
    """The camera's car drives beside its way, faster or slower."""

    USUAL: ClassVar[float] = 3.0

    lateral: float = Field(0.0, ge=-50, le=50)
    """Metres to the left of its way."""
    speed: float = Field(1.0, ge=0, le=10)
    """Times its speed at the same place of its way; 0: it stands."""

    @model_validator(mode="after")
    def _changes(self) -> "Ego":
        if not self.lateral and self.speed == 1:
            raise ValueError("give 'lateral', or a 'speed' other than 1")
        return self


Change = Remove | Speed | Stop | Reverse | Shift | Swap | Duplicate | Rescale | Ego


class Step(Settings):
    """One step of an edit: exactly one of these."""

    remove: Remove | None = None
    speed: Speed | None = None
    stop: Stop | None = None
    reverse: Reverse | None = None
    shift: Shift | None = None
    swap: Swap | None = None
    duplicate: Duplicate | None = None
    rescale: Rescale | None = None
    ego: Ego | None = None

    @model_validator(mode="after")
    def _is_one(self) -> "Step":
        if sum(change is not None for _, change in self) != 1:
            raise ValueError(f"a step is one of {', '.join(type(self).model_fields)}")
        return self

    @model_serializer(mode="wrap")
    def _without_the_others(self, dump: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        return {kind: change for kind, change in dump(self).items() if change is not None}

    @property
    def kind(self) -> str:
        """The name of the field that is set."""
        return next(kind for kind, change in self if change is not None)

    @property
    def change(self) -> Change:
        """What the step does."""
        return getattr(self, self.kind)


class Edit(Settings):
    """Steps, each acting on what the steps before it made of the drive."""

    steps: tuple[Step, ...] = Field(min_length=1)
