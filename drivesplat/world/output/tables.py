"""Writer for the tables of nuScenes v1.0.

Schema: https://www.nuscenes.org/nuscenes (nuScenes schema), as nuscenes-devkit 1.2 reads it.
"""

import numpy as np

from drivesplat.readers.nuscenes.table_rows import TableRows, pose_columns
from drivesplat.readers.nuscenes.tokens import token
from drivesplat.settings.world import WorldSettings
from drivesplat.world.optics.lidar import scan_pattern, spin_of
from drivesplat.world.optics.rig import RigSensor, recording_sensors
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

    def __init__(self, scene: str, description: str, source: str, start_us: int, world: WorldSettings):
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
        self._start_us = start_us

    def add_sample(self, index: int, time_us: int) -> None:
        """Adds a key frame, `time_us` after the start of the drive."""
        row = self.add_linked(
            "sample", (), token(self.scene, "sample", index), timestamp=self._start_us + time_us,
            scene_token=token(self.scene),
        )  # fmt: skip
        self._scene_row["nbr_samples"] += 1
        self._scene_row["first_sample_token"] = self._scene_row["first_sample_token"] or row["token"]
        self._scene_row["last_sample_token"] = row["token"]

    def add_data(
        self, sensor: RigSensor, index: int, time_us: int, is_key: bool, ego_to_global: np.ndarray,
        size: tuple[int, int],
    ) -> tuple[str, str]:  # fmt: skip
        """Adds a recording of key frame `index`, with its ego pose (4, 4). `size`: width, height; (0, 0) for LiDAR.

        Returns its token and the path of its file relative to the dataset's root.
        """
        timestamp = self._start_us + time_us
        name = token(self.scene, sensor.channel, time_us)
        suffix = "jpg" if sensor.is_camera else "pcd.bin"
        folder = "samples" if is_key else "sweeps"
        path = f"{folder}/{sensor.channel}/{self.scene}__{sensor.channel}__{timestamp}.{suffix}"
        self.add("ego_pose", name, timestamp=timestamp, **pose_columns(ego_to_global))
        self.add_linked(
            "sample_data", (sensor.channel,), name, sample_token=token(self.scene, "sample", index),
            ego_pose_token=name, calibrated_sensor_token=token("calibrated", sensor.channel), timestamp=timestamp,
            fileformat=suffix.split(".")[0], is_key_frame=is_key, width=size[0], height=size[1], filename=path,
        )  # fmt: skip
        return name, path

    def add_box(
        self, name: str, category: str, attribute: str | None, index: int, box_to_global: np.ndarray, size: np.ndarray,
        visible: float, lidar_points: int,
    ) -> None:  # fmt: skip
        """Adds a box at key frame `index`: pose (4, 4) of its centre; `size` (3,): length, width, height in metres."""
        self.add_annotation(
            (self.scene, "annotation", name, index), instance_token(self.scene, name), category, size,
            sample_token=token(self.scene, "sample", index), visibility_token=visibility_level(visible),
            attribute_tokens=[token(attribute)] if attribute else [], num_lidar_pts=lidar_points,
            **pose_columns(box_to_global),
        )  # fmt: skip
