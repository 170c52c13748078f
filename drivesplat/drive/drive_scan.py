"""What a LiDAR measures of a drive."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Float64, Int16
from torch import Tensor

from drivesplat.drive.drive_view import arrays_of
from drivesplat.errors import RequestError
from drivesplat.lidar.moved_sensor import places_of_returns
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scan_record import RecordedScan

PointFrame = Literal["world", "sensor"]
"""The frames in which points can be given."""


@dataclass(frozen=True)
class DriveScan:
    """A scan of b beams and a firings, as tensors on the model's device.

    `range` in metres from the sensor's position at the ray's own time, 0 where no Gaussian is met; `probability` of a
    return; `returned`, the rays that more probably return than not; `intensity` in [0, 1]; `instance`, the index into
    `objects` of the object that a ray meets, -1 for anything else. `objects` are the ids of the objects that are
    present and of which the model has Gaussians. `sensor` has the rays with their times, the sensor's pose at the
    scan's time and its velocities.
    """

    objects: tuple[str, ...]
    sensor: RecordedScan
    range: Float[Tensor, "b a"]
    probability: Float[Tensor, "b a"]
    returned: Bool[Tensor, "b a"]
    intensity: Float[Tensor, "b a"]
    instance: Int16[Tensor, "b a"]

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
