"""What a camera sees and a LiDAR measures of a drive."""

from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Float64, Int16
from torch import Tensor

from drivesplat.errors import RequestError
from drivesplat.lidar.moved_sensor import places_of_returns
from drivesplat.rendering.color_bytes import uint8_image
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scan_record import RecordedScan

PointFrame = Literal["world", "sensor"]
"""The frames in which points can be given."""


@dataclass(frozen=True)
class ObjectBox:
    """The box of an object that an image shows.

    `size` is length, width, height in metres, at `object_to_world` (4, 4) (object: x forward, y left, z up, at the
    centre). `box_2d` is the projected box, clipped to the image: left, top, right, bottom in continuous pixels;
    `visible_share` is the share of the object, also of what lies outside the image, that the image shows.
    """

    id: str
    category: str
    size: np.ndarray
    object_to_world: np.ndarray
    box_2d: tuple[float, float, float, float]
    visible_share: float


@dataclass(frozen=True)
class DriveView:
    """A rendering, as tensors on the model's device. What was not asked for is None.

    `rgb` in [0, 1]; `depth` along the camera's axis in metres (from a distorted camera the distance), 0 where no
    Gaussian is met; `alpha`, how opaque the scene is there without the sky; `instance`, the index into `objects` of the
    object that contributes most to a pixel, -1 where something else does; `semantic`, the index into `classes` of what
    contributes most; `valid`, whether the lens sees a direction there and the vehicle's own body does not cover it;
    `boxes` of the objects that the image shows. `objects` are the ids of the objects that are present and of which the
    model has Gaussians. `classes` are the sky, the parts of the model without objects, and the classes of its objects.
    """

    objects: tuple[str, ...]
    rgb: Float[Tensor, "h w 3"] | None = None
    depth: Float[Tensor, "h w"] | None = None
    alpha: Float[Tensor, "h w"] | None = None
    instance: Int16[Tensor, "h w"] | None = None
    semantic: Int16[Tensor, "h w"] | None = None
    valid: Bool[Tensor, "h w"] | None = None
    boxes: tuple[ObjectBox, ...] | None = None
    classes: tuple[str, ...] = ()

    @property
    def image(self) -> np.ndarray:
        """`rgb` as an image (h, w, 3) uint8, with the bytes of a film's frame. Raises ResultError where it contains
        NaN, RequestError where `rgb` was not asked for."""
        if self.rgb is None:
            raise RequestError("the rendering has no rgb: ask for it in `outputs`")
        return uint8_image(self.rgb)

    def arrays(self) -> dict[str, np.ndarray]:
        """The tensors by name as arrays in main memory."""
        return arrays_of(self)


@dataclass(frozen=True)
class DriveScan:
    """A scan of b beams and a firings, as tensors on the model's device.

    `range` in metres from the sensor's position at the ray's own time, 0 where no Gaussian is met; `probability` of a
    return; `returned`, the rays that more probably return than not; `intensity` in [0, 1]; `instance`, the index into
    `objects` of the object that a ray meets, -1 for anything else (None: not asked for). `objects` are the ids of the
    objects that are present and of which the model has Gaussians. `sensor` has the rays with their times, the sensor's
    pose at the scan's time and its velocities.
    """

    objects: tuple[str, ...]
    sensor: RecordedScan
    range: Float[Tensor, "b a"]
    probability: Float[Tensor, "b a"]
    returned: Bool[Tensor, "b a"]
    intensity: Float[Tensor, "b a"]
    instance: Int16[Tensor, "b a"] | None

    def points(self, frame: PointFrame = "world") -> Float64[np.ndarray, "n 3"]:
        """The returns, beam by beam, in metres: in the world, or in the sensor's frame at the scan's time, in which the
        sensor's motion is compensated."""
        if frame not in get_args(PointFrame):
            raise RequestError(f"there is no frame {frame!r} of points; there are: {', '.join(get_args(PointFrame))}")
        ranges, returned = self.range.cpu().numpy(), self.returned.cpu().numpy()
        places, _ = places_of_returns(self.sensor, ranges, returned)
        return places if frame == "world" else apply(inverse(self.sensor.sensor_to_world), places)

    def arrays(self) -> dict[str, np.ndarray]:
        """The tensors by name as arrays in main memory."""
        return arrays_of(self)


def arrays_of(record: Any) -> dict[str, np.ndarray]:
    """The tensors of a dataclass by name as arrays in main memory."""
    named = {field.name: getattr(record, field.name) for field in fields(record)}
    return {name: values.cpu().numpy() for name, values in named.items() if isinstance(values, Tensor)}
