"""Edits of a recorded drive: changed motion and colours of tracks, changed motion of the camera.

Units: metres, degrees, m/s. Times are seconds since the scene's first image, which is the start of the film.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, ConfigDict, Field, model_serializer, model_validator

from drivesplat.settings import Settings


def _in_quotes(value: Any) -> Any:
    if isinstance(value, bool | int | float):
        raise ValueError("an id is text: put it in quotes as it stands in tracks.csv")
    return value


Id = Annotated[str, Field(min_length=1), BeforeValidator(_in_quotes)]
"""A track's id from tracks.csv, a unique prefix of it, or the name of a duplicate."""


class Gradual(Settings):
    """A change with an optional transition."""

    USUAL: ClassVar[float] = 0.0
    """Duration in seconds where only a start is given."""

    start: float | None = Field(None, ge=0)
    """Start of the transition (seconds). null = the change holds from the beginning."""
    duration: float | None = Field(None, ge=0)
    """Length of the transition (seconds). 0 = a jump."""

    @model_validator(mode="after")
    def _a_duration_has_a_start(self) -> "Gradual":
        if self.duration is not None and self.start is None:
            raise ValueError("'duration' without 'start': say at which second the change begins")
        return self


class Remove(Settings):
    """Removes the track."""

    track: Id


class Speed(Gradual):
    """Changes the track's speed along its path; without `start`, from its first annotation on."""

    USUAL: ClassVar[float] = 1.0

    track: Id
    factor: float | None = Field(None, gt=0, le=10)
    """Factor on the recorded speed at the same place of the path."""
    to: float | None = Field(None, gt=0, le=100)
    """New speed (m/s)."""

    @model_validator(mode="after")
    def _factor_or_to(self) -> "Speed":
        if (self.factor is None) == (self.to is None):
            raise ValueError("give either 'factor' or 'to' (m/s)")
        return self


class Stop(Settings):
    """Stops the track on its path for the rest of the drive."""

    track: Id
    at: float = Field(ge=0)
    """Start of braking (seconds)."""
    duration: float = Field(2.0, ge=0)
    """Length of braking (seconds)."""


class Reverse(Settings):
    """Reverses the track's motion along its path, from its last position to its first."""

    track: Id
    turn: bool = False
    """Turn the vehicle round, so that it faces the direction of travel."""


class Shift(Gradual):
    """Moves the track off its path."""

    USUAL: ClassVar[float] = 3.0

    track: Id
    lateral: float = Field(0.0, ge=-50, le=50)
    """Offset to its left (metres)."""
    longitudinal: float = Field(0.0, ge=-200, le=200)
    """Offset forward along its path (metres)."""
    yaw: float = Field(0.0, ge=-360, le=360)
    """Rotation to its left about its vertical axis (degrees)."""

    @model_validator(mode="after")
    def _shifts(self) -> "Shift":
        if not (self.lateral or self.longitudinal or self.yaw):
            raise ValueError("give at least one of 'lateral', 'longitudinal' and 'yaw'")
        return self


class Swap(Settings):
    """Swaps the paths of two tracks."""

    model_config = ConfigDict(serialize_by_alias=True)

    track: Id
    other: Id = Field(alias="with")


class Duplicate(Settings):
    """Copies a track with the effect of all earlier steps. Later steps may name the copy."""

    model_config = ConfigDict(serialize_by_alias=True)

    track: Id
    name: Id = Field(alias="as")
    """The copy's id: letters, digits, '_', '-' and '.'."""
    longitudinal: float = Field(0.0, ge=-200, le=200)
    """Offset forward along the path (metres)."""
    lateral: float = Field(0.0, ge=-50, le=50)
    """Offset to the left of the original (metres)."""
    delay: float = Field(0.0, ge=-60, le=60)
    """Delay of the copy (seconds)."""
    phase: float = Field(0.0, ge=-1, le=1)
    """Cycles by which the gait of a deformable copy is ahead: 0.5, and the other foot is in front."""


Waypoint = tuple[
    Annotated[float, Field(ge=-60, le=600)], Annotated[float, Field(ge=-500, le=500)],
    Annotated[float, Field(ge=-100, le=100)],
]  # fmt: skip
"""Seconds; metres ahead and metres to the left of the ego vehicle at the scene's first image."""


def _require_increasing(path: tuple[Waypoint, ...]) -> None:
    if not path:
        raise ValueError("give at least one point in 'path'")
    if any(later[0] <= earlier[0] for earlier, later in pairwise(path)):
        raise ValueError("the seconds of 'path' must increase from point to point")


class Place(Settings):
    """Places a copy of the track on a given path. Later steps may name the copy."""

    model_config = ConfigDict(serialize_by_alias=True)

    track: Id
    name: Id = Field(alias="as")
    """The copy's id: letters, digits, '_', '-' and '.'."""
    path: tuple[Waypoint, ...]
    """Points of its path, in time order. One point: it stands there, facing as the ego vehicle did."""
    yaw: float = Field(0.0, ge=-360, le=360)
    """Rotation to its left about its vertical axis (degrees)."""
    phase: float = Field(0.0, ge=-1, le=1)
    """Cycles by which the gait of a deformable copy is ahead."""

    @model_validator(mode="after")
    def _times_increase(self) -> "Place":
        _require_increasing(self.path)
        return self


Offset = tuple[Annotated[float, Field(ge=-500, le=500)], Annotated[float, Field(ge=-100, le=100)]]
"""Metres ahead and metres to the left of the ego vehicle at the scene's first image."""


class Insert(Settings):
    """Inserts an asset: an object of another drive, or a copy of one of this drive. Later steps may name it."""

    model_config = ConfigDict(serialize_by_alias=True)

    asset: str = Field(min_length=1)
    """`{scene}/{track}` or `{scene}/{method}/{track}`, whose asset a method of the config has; or an asset's folder:
    a path that starts with `/`, `./`, `../` or `~`."""
    name: Id = Field(alias="as")
    """The object's id: letters, digits, '_', '-' and '.'."""
    path: tuple[Waypoint, ...] | None = None
    """Points of its path, in time order."""
    at: Offset | None = None
    """The place where it stands, facing as the ego vehicle did."""
    follow: Id | None = None
    """The track whose path it takes."""
    start: float | None = Field(None, ge=-60, le=600)
    """The second at which it appears where it stands, or where the followed track begins. null = as that track does."""
    speed: float | None = Field(None, gt=0, le=100)
    """Its speed (m/s) on the path of the followed track. null = that of the track."""
    longitudinal: float = Field(0.0, ge=-200, le=200)
    """Metres that it is further along the path of the followed track."""
    lateral: float = Field(0.0, ge=-50, le=50)
    """Metres to the left of the path of the followed track."""
    yaw: float = Field(0.0, ge=-360, le=360)
    """Rotation to its left about its vertical axis (degrees)."""
    phase: float = Field(0.0, ge=-1, le=1)
    """Cycles by which its gait is ahead."""
    shadow: bool = True
    """Whether it darkens the ground."""
    match_exposure: bool = True
    """Whether its colours are scaled by the brightness of the ground here and where it was recorded."""

    @model_validator(mode="after")
    def _has_one_path(self) -> "Insert":
        if sum(given is not None for given in (self.path, self.at, self.follow)) != 1:
            raise ValueError("give one of 'path', 'at' and 'follow'")
        if self.path is not None:
            _require_increasing(self.path)
        along = {"speed": self.speed is not None, "longitudinal": self.longitudinal, "lateral": self.lateral}
        if self.follow is None and any(along.values()):
            raise ValueError(f"{next(key for key, given in along.items() if given)!r} is for an object with 'follow'")
        if self.path is not None and self.start is not None:
            raise ValueError("'path' has the seconds of its points: leave out 'start'")
        return self

    @property
    def waypoints(self) -> tuple[Waypoint, ...]:
        """The points of its path; none with `follow`."""
        return self.path or (() if self.at is None else ((self.start or 0.0, *self.at),))


class Rescale(Settings):
    """Scales the track about the centre of its floor."""

    track: Id
    factor: float = Field(ge=0.1, le=10)


def _color(value: Any) -> Any:
    """A CSS name or '#rrggbb' as red, green and blue in [0, 1]; other values unchanged."""
    if not isinstance(value, str):
        return value
    from PIL import ImageColor  # late: planning rarely needs it

    try:
        return tuple(channel / 255 for channel in ImageColor.getrgb(value)[:3])
    except ValueError:
        raise ValueError(
            "no colour has this name; give a CSS name, '#rrggbb' in quotes, or [red, green, blue] from 0 to 1"
        ) from None


Channel = Annotated[float, Field(ge=0, le=1)]
Color = Annotated[tuple[Channel, Channel, Channel], BeforeValidator(_color)]
"""Red, green and blue in [0, 1], as images encode them. Read from these, a CSS name or '#rrggbb'."""


MIN_CHROMA = 0.2
"""The least difference of the channels, in [0, 1], of paint that does not look like tyres, glass and highlights."""


class Recolour(Settings):
    """Changes the colours of the track: those of its paint if `from` names it, otherwise of all its surfaces alike."""

    model_config = ConfigDict(serialize_by_alias=True)

    track: Id
    hue: float = Field(0.0, ge=-360, le=360)
    """Rotation of the hue (degrees): 120 turns red into green, green into blue, blue into red."""
    saturation: float = Field(1.0, ge=0, le=10)
    """Factor on the saturation. 0 = grey."""
    value: float = Field(1.0, ge=0, le=10)
    """Factor on the brightness."""
    colour: Color | None = None
    """The colour that white becomes; darker surfaces become darker shades of it. Also for grey vehicles."""
    paint: Color | None = Field(None, alias="from")
    """The recorded colour of the paint, which becomes `colour`. Grey surfaces stay: tyres, glass, highlights."""

    @model_validator(mode="after")
    def _changes(self) -> "Recolour":
        if self.colour is not None and (self.hue or self.saturation != 1):
            raise ValueError("'colour' replaces hue and saturation: give it alone, or with 'value'")
        if self.paint is not None and self.colour is None:
            raise ValueError("'from' without 'colour': say which colour the paint becomes")
        if self.paint is not None and max(self.paint) - min(self.paint) < MIN_CHROMA:
            raise ValueError(
                "'from' is a grey: white, grey and black paint looks like tyres and glass; give 'colour' alone"
            )
        if self.colour is None and self.hue % 360 == 0 and self.saturation == self.value == 1:
            raise ValueError("give at least one of 'hue', 'saturation', 'value' and 'colour', other than 0, 1 and 1")
        return self


class Ego(Gradual):
    """Changes the path and the speed of the ego vehicle, which carries the camera."""

    USUAL: ClassVar[float] = 3.0

    lateral: float = Field(0.0, ge=-50, le=50)
    """Offset to the left of its path (metres)."""
    speed: float = Field(1.0, ge=0, le=10)
    """Factor on the recorded speed at the same place of the path. 0 = it stands."""

    @model_validator(mode="after")
    def _changes(self) -> "Ego":
        if not self.lateral and self.speed == 1:
            raise ValueError("give 'lateral', or a 'speed' other than 1")
        return self


Change = Remove | Speed | Stop | Reverse | Shift | Swap | Duplicate | Place | Insert | Rescale | Recolour | Ego


def _short(value: Any) -> str:
    """A value of a step's field in a line of text; colours as '#rrggbb', places as '[20 3]'."""
    if isinstance(value, (list, tuple)):
        if len(value) == 2 and isinstance(value[0], float):
            return "[" + " ".join(_short(number) for number in value) + "]"
        if value and isinstance(value[0], float):
            return "#" + "".join(f"{round(255 * channel):02x}" for channel in value)
        return ", ".join("[" + " ".join(_short(number) for number in point) + "]" for point in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


class Step(Settings):
    """One step of an edit. Exactly one field is set."""

    remove: Remove | None = None
    speed: Speed | None = None
    stop: Stop | None = None
    reverse: Reverse | None = None
    shift: Shift | None = None
    swap: Swap | None = None
    duplicate: Duplicate | None = None
    place: Place | None = None
    insert: Insert | None = None
    rescale: Rescale | None = None
    recolour: Recolour | None = None
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
        return getattr(self, self.kind)

    @property
    def in_words(self) -> str:
        """The step in one line: its name, the track, and the fields that were set.

        >>> Step(stop=Stop(track="6e5c", at=3)).in_words
        'stop 6e5c, at 3'
        """
        given = self.change.model_dump(exclude_defaults=True, by_alias=True, exclude={"track"})
        track = [self.change.track] if hasattr(self.change, "track") else []
        return ", ".join([" ".join([self.kind, *track]), *(f"{name} {_short(value)}" for name, value in given.items())])

    @property
    def begins(self) -> float:
        """The second from which on the step changes something: 0 where it does so from the beginning."""
        change: Any = self.change
        if isinstance(change, Place | Insert):
            points = change.path if isinstance(change, Place) else change.waypoints
            return max(0.0, points[0][0] if points else change.start or 0.0)
        return getattr(change, "start", getattr(change, "at", None)) or 0.0


class Edit(Settings):
    """Steps that are applied in order, each to the result of the steps before it."""

    steps: tuple[Step, ...] = Field(min_length=1)
