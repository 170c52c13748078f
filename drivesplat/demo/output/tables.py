"""Writer for the tables of nuScenes v1.0.

Schema: https://www.nuscenes.org/nuscenes (nuScenes schema), as nuscenes-devkit 1.2 reads it.
"""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.demo.optics.lidar import scan_pattern
from drivesplat.demo.optics.rig import DemoSensor, recording_sensors
from drivesplat.demo.tokens import instance_token, token
from drivesplat.io.storage import write_json
from drivesplat.readers.nuscenes.layout import TABLES
from drivesplat.settings.world import WorldSettings

MAP = "maps/empty.png"
ATTRIBUTES = (
    "vehicle.moving", "vehicle.parked", "vehicle.stopped", "pedestrian.moving", "pedestrian.standing",
    "cycle.with_rider",
)  # fmt: skip
VISIBILITY = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}


def visibility_level(fraction: float) -> str:
    """nuScenes' level of a visible fraction in [0, 1]: '1' up to 40 %, '2' up to 60, '3' up to 80, '4' above."""
    return str(1 + sum(fraction > bound for bound in (0.4, 0.6, 0.8)))


class NuScenesTables:
    """The tables of one drive. `scene` is its name without `scene-`; `source` becomes part of the log's name."""

    def __init__(self, scene: str, description: str, source: str, start_us: int, world: WorldSettings):
        self.scene = scene
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
        log = {"logfile": f"demo-{source}", "vehicle": "demo", "date_captured": "2026-01-01", "location": "demo"}
        self._add("log", token(scene, "log"), **log)
        self._add("map", token("map"), category="semantic_prior", filename=MAP, log_tokens=[token(scene, "log")])
        for level, name in VISIBILITY.items():
            self._add("visibility", level, level=name, description=f"visible fraction {name[1:]} %")
        for attribute in ATTRIBUTES:
            self._add("attribute", token(attribute), name=attribute, description="")
        for sensor in recording_sensors(world):
            self._sensor(sensor, world)
        self._scene_row = self._add(
            "scene", token(scene), log_token=token(scene, "log"), nbr_samples=0, first_sample_token="",
            last_sample_token="", name=f"scene-{scene}", description=description,
        )  # fmt: skip
        self._start_us = start_us
        self._last: dict[tuple, dict[str, Any]] = {}

    def _add(self, table: str, token: str, **values: Any) -> dict[str, Any]:
        row = {"token": token, **values}
        self.rows[table].append(row)
        return row

    def _add_linked(self, table: str, chain: tuple, token: str, **values: Any) -> dict[str, Any]:
        """Adds a row that is linked to the one before it in the same `chain`."""
        before = self._last.get((table, *chain))
        row = self._add(table, token, prev=before["token"] if before else "", next="", **values)
        if before:
            before["next"] = row["token"]
        self._last[(table, *chain)] = row
        return row

    def _sensor(self, sensor: DemoSensor, world: WorldSettings) -> None:
        """`readout_s`, `readout_direction`, `beam_elevations` and `azimuth_steps` are additions to nuScenes' schema."""
        modality = "camera" if sensor.is_camera else "lidar"
        self._add("sensor", token("sensor", sensor.channel), channel=sensor.channel, modality=modality)
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
            }  # fmt: skip
        self._add(
            "calibrated_sensor", token("calibrated", sensor.channel), sensor_token=token("sensor", sensor.channel),
            translation=list(sensor.translation), rotation=sensor.rotation.tolist(), **details,
        )  # fmt: skip

    def add_sample(self, index: int, time_us: int) -> None:
        """Adds a key frame, `time_us` after the start of the drive."""
        row = self._add_linked(
            "sample", (), token(self.scene, "sample", index), timestamp=self._start_us + time_us,
            scene_token=token(self.scene),
        )  # fmt: skip
        self._scene_row["nbr_samples"] += 1
        self._scene_row["first_sample_token"] = self._scene_row["first_sample_token"] or row["token"]
        self._scene_row["last_sample_token"] = row["token"]

    def add_data(
        self, sensor: DemoSensor, index: int, time_us: int, is_key: bool, ego_to_global: np.ndarray,
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
        self._add("ego_pose", name, timestamp=timestamp, **_pose_of(ego_to_global))
        self._add_linked(
            "sample_data", (sensor.channel,), name, sample_token=token(self.scene, "sample", index),
            ego_pose_token=name, calibrated_sensor_token=token("calibrated", sensor.channel), timestamp=timestamp,
            fileformat=suffix.split(".")[0], is_key_frame=is_key, width=size[0], height=size[1], filename=path,
        )  # fmt: skip
        return name, path

    def add_annotation(
        self, name: str, category: str, attribute: str | None, index: int, box_to_global: np.ndarray, size: np.ndarray,
        visible: float, lidar_points: int,
    ) -> None:  # fmt: skip
        """Adds a box at key frame `index`: pose (4, 4) of its centre; `size` (3,): length, width, height in metres."""
        instance = instance_token(self.scene, name)
        row = self._add_linked(
            "sample_annotation", (name,), token(self.scene, "annotation", name, index),
            sample_token=token(self.scene, "sample", index), instance_token=instance,
            visibility_token=visibility_level(visible), attribute_tokens=[token(attribute)] if attribute else [],
            size=[size[1], size[0], size[2]], num_lidar_pts=lidar_points, num_radar_pts=0, **_pose_of(box_to_global),
        )  # fmt: skip
        if not any(r["name"] == category for r in self.rows["category"]):
            self._add("category", token("category", category), name=category, description="")
        known = next((r for r in self.rows["instance"] if r["token"] == instance), None) or self._add(
            "instance", instance, category_token=token("category", category), nbr_annotations=0,
            first_annotation_token=row["token"],
        )  # fmt: skip
        known["nbr_annotations"] += 1
        known["last_annotation_token"] = row["token"]

    def write(self, root: Path, version: str) -> None:
        """Writes `root`/`version`/*.json and the map image that nuscenes-devkit requires."""
        (root / MAP).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (8, 8)).save(root / MAP)
        for name, rows in self.rows.items():
            write_json(root / version / f"{name}.json", rows)


def _pose_of(pose: np.ndarray) -> dict[str, list[float]]:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return {"translation": pose[:3, 3].tolist(), "rotation": [w, x, y, z]}
