"""The content of scans.npz: the revolutions of all LiDARs as rays, resolved once for training, metrics and pictures.

The stage `scans` writes it (`drivesplat.preprocess.scans`).
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int16

from drivesplat.io.array_file import read_typed_arrays
from drivesplat.io.storage import Provenance, no_provenance
from drivesplat.scene.rigid import apply
from drivesplat.scene.scan import Scan

RULE = "scans"
NO_OBJECT = -1
"""In `RecordedScan.objects`: a ray without a return, or whose return lies in no box."""


@dataclass(frozen=True)
class RecordedScan:
    """A revolution of b beams and a firings of a LiDAR.

    `group` is its split: 'train', a held-out group or 'excluded'. `seconds` count from the scene's first image.
    `sensor_to_world` (metres) holds at the sweep's timestamp; `linear` (m/s) and `angular` (rad/s) are the sensor's
    mean velocities during the revolution, in its frame at that timestamp. `measured` is False for rays that say
    nothing: those that meet the ego vehicle, and those of a broken sector. `objects` are the indices into
    `ScanRecords.tracks` of the boxes that returns lie in, at their rays' times, or NO_OBJECT. `blocked` are rays that
    never return in training scans, wherever the sensor is: the vehicle is in their way.
    """

    lidar: str
    timestamp: int
    seconds: float
    sample_index: int
    is_key_frame: bool
    group: str
    sensor_to_world: Float64[np.ndarray, "4 4"]
    linear: Float64[np.ndarray, "3"]
    angular: Float64[np.ndarray, "3"]
    scan: Scan
    measured: Bool[np.ndarray, "b a"]
    objects: Int16[np.ndarray, "b a"]
    blocked: Bool[np.ndarray, "b a"]

    def points(self) -> np.ndarray:
        """The measured returns (n, 3) in world coordinates, metres, beam by beam."""
        from scipy.spatial.transform import Rotation  # here: planning imports this module, and scipy takes long

        chosen = self.scan.returned & self.measured
        offsets = self.scan.rays.offsets_s[chosen].astype(np.float64)[:, None]
        seen = self.scan.rays.directions()[chosen] * self.scan.ranges[chosen, None]
        at_timestamp = Rotation.from_rotvec(offsets * self.angular).apply(seen) + offsets * self.linear
        return apply(self.sensor_to_world, at_timestamp)

    @property
    def objects_met(self) -> np.ndarray:
        """`objects` of `points` (n,)."""
        return self.objects[self.scan.returned & self.measured]


@dataclass(frozen=True)
class ScanRecords:
    """The content of scans.npz: `scans` in order of LiDAR and time, and the ids of the scene's tracks in its order."""

    scans: list[RecordedScan]
    tracks: list[str]
    provenance: Provenance = field(default_factory=no_provenance)

    def of_group(self, group: str) -> list[RecordedScan]:
        """The scans of a split."""
        return [scan for scan in self.scans if scan.group == group]


def read_scans(path: str | Path) -> ScanRecords:
    """Reads scans.npz. Raises ResultError that names the file and its rule if it is invalid."""
    return read_typed_arrays(path, RULE, ScanRecords, "scans")
