"""The light of a scene: how dark its vehicles make the ground."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from drivesplat.io.storage import Provenance, read_record, unreadable, write_json

RULE = "light"
SHRUNK = np.array([0.95, 0.9, 0.9])
"""What casts the shadow of a vehicle: its box, smaller by these factors, since a body is rounder than its box."""
RIM = 0.3
"""The distance beside a box at which its contact shadow has fallen to 1/e, in heights of the box."""


@dataclass(frozen=True)
class SceneLight:
    """`contact` is the share of its brightness, as images encode it, that ground loses at the rim of a vehicle, and
    `cast` the one that it loses where the vehicle hides the sun, which stands at `azimuth_deg`, degrees to the left of
    the world's x axis, and `elevation_deg`; None where no shadow of a sun is seen."""

    contact: float
    cast: float = 0.0
    azimuth_deg: float | None = None
    elevation_deg: float | None = None

    @property
    def sun(self) -> Float[np.ndarray, "3"] | None:
        """The direction to the sun, a unit vector in the world; None without one."""
        if self.azimuth_deg is None or self.elevation_deg is None:
            return None
        return direction(self.azimuth_deg, self.elevation_deg)

    @property
    def in_words(self) -> str:
        """The light in one line."""
        if self.sun is None:
            return f"no shadow of a sun, contact shadows of {self.contact:.0%}"
        return f"sun at {self.azimuth_deg:.0f}, {self.elevation_deg:.0f} degrees, shadows of {self.cast:.0%}"


@dataclass(frozen=True, eq=False)
class Shade:
    """The shadow that an object casts on the ground: that of a box of `size` (3,) in metres in the light of a scene."""

    size: Float[np.ndarray, "3"]
    light: SceneLight


OVERCAST = SceneLight(contact=0.1)
"""The light of a scene of which none is known."""


def direction(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3"]:
    """The unit vector in this direction: degrees from the x axis to the y axis, and above the horizontal."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])


def hides_sun(
    points: Float[np.ndarray, "n 3"], size: Float[np.ndarray, "n 3"], sun: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Whether a box hides the sun from points in its frame. `size` (n, 3) in metres and the directions to the `sun`
    (n, 3) are in the frames of the boxes, too."""
    half = size / 2.0 * SHRUNK
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.stack([(-half - points) / sun, (half - points) / sun])
    enter, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
    return leave > np.maximum(enter, 0.0)


def contact_shadow(points: Float[np.ndarray, "n 3"], size: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """The strength of the contact shadow of boxes on the ground at points in their frames: 1 at their rims and below
    them."""
    beside = np.linalg.norm(np.maximum(np.abs(points[:, :2]) - size[:, :2] / 2.0, 0.0), axis=1)
    return np.exp(-((beside / (RIM * size[:, 2])) ** 2))


def write_light(path: str | Path, light: SceneLight, provenance: Provenance) -> None:
    write_json(path, {"schema": 1, **asdict(light), "provenance": provenance})


def read_light(path: str | Path) -> SceneLight:
    """Reads light.json. Raises ResultError that names the file where it is not one."""
    names = ("contact", "cast", "azimuth_deg", "elevation_deg")
    record = read_record(path, RULE, *names)
    try:
        light = SceneLight(*(None if record[name] is None else float(record[name]) for name in names))
        if not (0.0 <= light.contact < 1.0 and 0.0 <= light.cast < 1.0):
            raise ValueError("contact and cast are shares from 0 to 1")
        if light.sun is not None and not 1.0 <= light.elevation_deg <= 90.0:
            raise ValueError(f"the sun stands at {light.elevation_deg:g} degrees")
        return light
    except (TypeError, ValueError) as error:
        raise unreadable(path, RULE, f"not the light of a scene ({error})") from error
