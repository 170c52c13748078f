"""Writer for the tables of nuScenes v1.0.

Schema: https://www.nuscenes.org/nuscenes (nuScenes schema), as nuscenes-devkit 1.2 reads it.
"""

import numpy as np

from drivesplat.readers.nuscenes.table_rows import TableRows, pose_columns
from drivesplat.readers.nuscenes.tokens import token
from drivesplat.settings.world import WorldSettings
from drivesplat.world.optics.lidar import scan_pattern, spin_of
from drivesplat.world.optics.rig import image_height, recording_sensors
from drivesplat.world.output.recordings import START_US, KeyFrameBox, SensorFile
from drivesplat.world.tokens import instance_token

ATTRIBUTES = (
    "vehicle.moving", "vehicle.parked", "vehicle.stopped", "pedestrian.moving", "pedestrian.standing",
    "cycle.with_rider",
)  # fmt: skip


def visibility_level(fraction: float) -> str:
    """nuScenes' level of a visible fraction in [0, 1]: '1' up to 40 %, '2' up to 60, '3' up to 80, '4' above."""
    return str(1 + sum(fraction > bound for bound in (0.4, 0.6, 0.8)))


class NuScenesTables(TableRows):
    """The tables of one drive. `scene` is its name without `scene-`; `source` becomes part of the log's name."""

    def __init__(self, scene: str, description: str, source: str, world: WorldSettings):
        self.scene = scene
        log = {"logfile": f"demo-{source}", "vehicle": "demo", "date_captured": "2026-01-01", "location": "demo"}
        super().__init__(token(scene, "log"), log, ATTRIBUTES)
        for sensor in recording_sensors(world):
            # readout_s, readout_direction, beam_elevations, azimuth_steps and spin are additions to nuScenes' schema
            modality = "camera" if sensor.is_camera else "lidar"
            self.add("sensor", token("sensor", sensor.channel), channel=sensor.channel, modality=modality)
            if sensor.is_camera:
                shutter = {"readout_s": world.readout_s, "readout_direction": "down"}
                details = {
                    "camera_intrinsic": sensor.intrinsics(world.width).tolist(),
                    **(shutter if world.readout_s else {}),
                }
            else:
                pattern = scan_pattern(world.lidar, world.lidar_hz)
                steps = len(pattern.azimuths)
                details = {
                    "camera_intrinsic": [], "beam_elevations": pattern.elevations.tolist(), "azimuth_steps": steps,
                    **({"spin": spin_of(world.lidar_hz)} if world.lidar.spins else {}),
                }  # fmt: skip
            self.add(
                "calibrated_sensor",
                token("calibrated", sensor.channel),
                sensor_token=token("sensor", sensor.channel),
                translation=list(sensor.translation),
                rotation=sensor.rotation.tolist(),
                **details,
            )
        self._scene_row = self.add(
            "scene", token(scene), log_token=token(scene, "log"), nbr_samples=0, first_sample_token="",
            last_sample_token="", name=f"scene-{scene}", description=description,
        )  # fmt: skip
        self._size = world.width, image_height(world.width)

    def add_sample(self, index: int, time_us: int) -> None:
        """Adds a key frame, `time_us` after the start of the drive."""
        row = self.add_linked(
            "sample", (), token(self.scene, "sample", index), timestamp=START_US + time_us,
            scene_token=token(self.scene),
        )  # fmt: skip
        self._scene_row["nbr_samples"] += 1
        self._scene_row["first_sample_token"] = self._scene_row["first_sample_token"] or row["token"]
        self._scene_row["last_sample_token"] = row["token"]

    def add_data(self, file: SensorFile, ego_to_global: np.ndarray) -> None:
        """Adds a recording with its ego pose (4, 4)."""
        channel, timestamp = file.sensor.channel, START_US + file.time_us
        width, height = self._size if file.sensor.is_camera else (0, 0)
        self.add("ego_pose", file.token, timestamp=timestamp, **pose_columns(ego_to_global))
        self.add_linked(
            "sample_data", (channel,), file.token, sample_token=token(self.scene, "sample", file.index),
            ego_pose_token=file.token, calibrated_sensor_token=token("calibrated", channel), timestamp=timestamp,
            fileformat="jpg" if file.sensor.is_camera else "pcd", is_key_frame=file.is_key_frame, width=width,
            height=height, filename=file.path,
        )  # fmt: skip

    def add_box(self, box: KeyFrameBox) -> None:
        """Adds a box. Those of an object come in the order of time."""
        self.add_annotation(
            (self.scene, "annotation", box.name, box.index), instance_token(self.scene, box.name), box.category,
            box.size, sample_token=token(self.scene, "sample", box.index),
            visibility_token=visibility_level(box.visible),
            attribute_tokens=[token(box.attribute)] if box.attribute else [], num_lidar_pts=box.lidar_points,
            **pose_columns(box.pose),
        )  # fmt: skip
