"""The sensors of a nuScenes vehicle: mounts, trigger times and intrinsics.

Source: the calibration of a vehicle in Singapore (Caesar et al. 2020), rounded to millimetres, hundredths of a degree
and tenths of a pixel.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.scene.rigid import rigid
from drivesplat.settings.world import WorldSettings

FULL_WIDTH, FULL_HEIGHT = 1600, 900


@dataclass(frozen=True)
class RigSensor:
    """A camera or LiDAR. `translation` (metres) and `quaternion` (w, x, y, z; any length): sensor to ego (x forward, y
    left). `delay_us`: trigger time relative to the key frame. Cameras: `focal` and `center` in pixels of a 1600x900
    image, OpenCV's convention."""

    channel: str
    translation: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    delay_us: int
    focal: float = 0.0
    center: tuple[float, float] = (0.0, 0.0)

    @property
    def rotation(self) -> np.ndarray:
        """Unit quaternion (4,): w, x, y, z."""
        return np.array(self.quaternion) / np.linalg.norm(self.quaternion)

    @property
    def is_camera(self) -> bool:
        return self.focal > 0

    @property
    def sensor_to_ego(self) -> np.ndarray:
        """Mount (4, 4)."""
        return rigid(Rotation.from_quat(np.roll(self.rotation, -1)).as_matrix(), np.array(self.translation))

    def intrinsics(self, width: int) -> np.ndarray:
        """K (3, 3) for images `width` pixels wide, OpenCV's convention (integer coordinates at pixel centres)."""
        scale = width / FULL_WIDTH
        cx, cy = ((c + 0.5) * scale - 0.5 for c in self.center)
        return np.array([[self.focal * scale, 0.0, cx], [0.0, self.focal * scale, cy], [0.0, 0.0, 1.0]])


SENSORS = (
    RigSensor("LIDAR_TOP", (0.944, 0.0, 1.84), (0.7078, -0.0065, 0.0106, -0.7063), 0),
    RigSensor("CAM_FRONT_LEFT", (1.524, 0.495, 1.509), (0.6757, -0.6736, 0.2121, -0.2112), -43_100, 1272.6,
               (826.6, 479.8)),
    RigSensor("CAM_FRONT", (1.701, 0.016, 1.511), (0.4998, -0.5030, 0.4998, -0.4974), -35_500, 1266.4, (816.3, 491.5)),
    RigSensor("CAM_FRONT_RIGHT", (1.551, -0.493, 1.496), (0.2060, -0.2027, 0.6825, -0.6714), -27_600, 1260.8,
               (808.0, 495.3)),
    RigSensor("CAM_BACK_RIGHT", (1.015, -0.481, 1.562), (0.1228, -0.1324, -0.7004, 0.6905), -20_100, 1259.5,
               (807.3, 501.2)),
    RigSensor("CAM_BACK", (0.028, 0.003, 1.579), (0.5038, -0.4974, -0.4942, 0.5045), -10_400, 809.2, (829.2, 481.8)),
    RigSensor("CAM_BACK_LEFT", (1.036, 0.485, 1.591), (0.6924, -0.7032, -0.1165, 0.1120), -500, 1256.7,
               (792.1, 492.8)),
)  # fmt: skip


def image_height(width: int) -> int:
    """The height of images `width` pixels wide."""
    return round(width * FULL_HEIGHT / FULL_WIDTH)


def key_frame_time(world: WorldSettings, index: int) -> int:
    """Microseconds from the start of the drive to key frame `index`."""
    return round(index * 1_000_000 / world.key_frame_hz)


def recording_sensors(world: WorldSettings) -> tuple[RigSensor, ...]:
    """The LiDAR and the cameras that record."""
    channels = world.cameras or ()
    return tuple(sensor for sensor in SENSORS if not sensor.is_camera or sensor.channel in channels)


def trigger_times(sensor: RigSensor, world: WorldSettings) -> list[tuple[int, bool, int]]:
    """For each recording: microseconds since the start of the drive, whether it is a key frame, and the index of the
    key frame it belongs to."""
    rate = world.image_hz if sensor.is_camera else world.lidar_hz
    steps = rate // world.key_frame_hz if sensor.channel in (world.sweeps or ()) else 1
    return [
        (round(i * 1_000_000 / (steps * world.key_frame_hz)) + sensor.delay_us, i % steps == 0, -(-i // steps))
        for i in range((world.key_frames - 1) * steps + 1)
    ]
