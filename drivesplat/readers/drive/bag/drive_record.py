"""The drive.json of a bag: mounts and calibrations of its sensors, poses and files."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.bag.bag_map import BagCamera, BagLidar, BagMap, Calibration
from drivesplat.readers.drive.bag.images import calibration_of
from drivesplat.readers.drive.bag.recordings import SensorRecordings, grey_sentence, unposed_sentence
from drivesplat.readers.drive.bag.survey import BagSurvey
from drivesplat.readers.drive.bag.transforms import EgoTrack, TransformTree
from drivesplat.readers.drive.conversion import timed_poses
from drivesplat.readers.drive.poses import MAX_POSE_GAP, matrix_of
from drivesplat.readers.drive.write import pose_record
from drivesplat.scene.rigid import rigid

FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The rotation of an optical frame in one with x forward, y left, z up."""


class SensorMount:
    """The mount of a sensor: constant, or where tf moves it one for each time."""

    def __init__(self, sensor: BagCamera | BagLidar, tree: TransformTree, bag_map: BagMap, turn: np.ndarray):
        """`turn` (3, 3): the rotation of the sensor's frame to that of its images, if these are rectified."""
        self._frame, self._vehicle, self._tree, self._stated = sensor.frame, bag_map.vehicle, tree, None
        self._to_ego = matrix_of(bag_map.vehicle_to_ego, "vehicle_to_ego")
        forward = isinstance(sensor, BagCamera) and sensor.axes == "forward"
        self._axes = rigid((FORWARD if forward else np.eye(3)) @ turn.T, np.zeros(3))
        self.moves = False
        if sensor.mount is not None:
            self._stated = matrix_of(sensor.mount, f"the mount of {sensor.frame}")
        else:
            self.moves = not all(edge.constant for edge, _ in tree.require(sensor.frame, bag_map.vehicle))

    def at(self, stamps: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "m 4 4"]:
        """The sensor in the ego frame at times in microseconds."""
        if self._stated is not None:
            return np.tile(self._to_ego @ self._stated @ self._axes, (len(stamps), 1, 1))
        return self._to_ego @ self._tree.poses(self._frame, self._vehicle, stamps) @ self._axes


def calibrations_of(bag_map: BagMap, found: BagSurvey) -> tuple[dict[str, Calibration], dict[str, np.ndarray]]:
    """The calibrations of cameras, and the rotations (3, 3) of their frames to those of rectified images. Raises
    DatasetError where a camera has none."""
    calibrations, turns = {}, {}
    for name, camera in bag_map.cameras.items():
        turns[name] = np.eye(3)
        if camera.calibration is not None:
            calibrations[name] = camera.calibration
            continue
        samples = found.topics[camera.info].samples if camera.info in found.topics else ()
        if not samples:
            raise DatasetError(
                f"camera {name} has no CameraInfo; state its calibration in the map: calibration: {{width: …, height: "
                "…, K: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]}}"
            )
        faults = []
        for sample in samples:
            try:
                calibrations[name], turns[name] = calibration_of(sample, camera.rectified)
                break
            except DatasetError as error:
                faults.append(str(error))
        else:
            raise DatasetError(f"camera {name}: the CameraInfo on {camera.info} {faults[0]}")
    return calibrations, turns


class DriveOfBag:
    """What is known of a drive before its recordings are read. Raises DatasetError where a mount is missing."""

    def __init__(
        self,
        bag_map: BagMap,
        tree: TransformTree,
        ego: EgoTrack | None,
        calibrations: Mapping[str, Calibration],
        turns: Mapping[str, np.ndarray],
    ):
        self._map, self._tree, self._ego, self._calibrations = bag_map, tree, ego, calibrations
        sensors: dict[str, BagCamera | BagLidar] = {**bag_map.cameras, **bag_map.lidars}
        self._mounts = {
            name: SensorMount(sensor, tree, bag_map, turns.get(name, np.eye(3))) for name, sensor in sensors.items()
        }

    def record(self, recordings: Mapping[str, SensorRecordings], description: str) -> dict[str, Any]:
        """The content of drive.json with the files of `recordings`. Raises DatasetError where a sensor has none."""
        for one in recordings.values():
            if not one.files:
                why = "the vehicle has no pose at their times: check clock, world and vehicle in the map"
                why = why if one.unposed else one.damage or "there is none between --start and --end"
                raise DatasetError(f"none of {one.name}'s {one.count} messages is left: {why}")
        every = [stamp for one in recordings.values() for stamp in one.files]
        ego = None if self._ego is None else self._ego.reaching(min(every), max(every))
        cameras = {name: self._camera(name, recordings[name]) for name in self._map.cameras}
        lidars = {name: self._lidar(name, recordings[name]) for name in self._map.lidars}
        frames = [frame for name in cameras for frame in self._records("camera", recordings[name], ego)]
        sweeps = [sweep for name in lidars for sweep in self._records("lidar", recordings[name], ego)]
        return {
            "format": "drivesplat drive",
            "version": 1,
            "description": description,
            "cameras": cameras,
            "lidars": lidars,
            "ego_poses": [] if ego is None else timed_poses(ego.stamps, ego.poses),
            "key_frames": self._key_frames(recordings),
            "frames": frames,
            "sweeps": sweeps,
        }

    def _camera(self, name: str, recordings: SensorRecordings) -> dict[str, Any]:
        mount = {"sensor_to_ego": pose_record(self._middle(name, recordings))}
        return {**self._calibrations[name].model_dump(mode="json"), **mount}

    def _lidar(self, name: str, recordings: SensorRecordings) -> dict[str, Any]:
        lidar = self._map.lidars[name]
        return {
            "sensor_to_ego": pose_record(self._middle(name, recordings)),
            "revolution_s": lidar.revolution_s,
            "motion_compensated": lidar.motion_compensated,
        }

    def _middle(self, name: str, recordings: SensorRecordings) -> np.ndarray:
        stamps = sorted(recordings.files)
        return self._mounts[name].at(np.array([stamps[len(stamps) // 2]], dtype=np.int64))[0]

    def _records(self, kind: str, recordings: SensorRecordings, ego: EgoTrack | None) -> list[dict[str, Any]]:
        """Frames or sweeps in order of time; with poses of their own where tf moves the mount."""
        stamps, mount = np.array(sorted(recordings.files), dtype=np.int64), self._mounts[recordings.name]
        found = [{kind: recordings.name, "timestamp": int(at), "file": recordings.files[int(at)]} for at in stamps]
        if mount.moves and ego is not None:
            for one, vehicle, sensor in zip(found, ego.at(stamps), mount.at(stamps), strict=True):
                one[f"{kind}_to_world"] = pose_record(vehicle @ sensor)
                if kind == "camera":
                    one["ego_to_world"] = pose_record(vehicle)
        return found

    def _key_frames(self, recordings: Mapping[str, SensorRecordings]) -> list[int]:
        rule, kept = self._map.key_frames, []
        for stamp in sorted(recordings[rule.sensor].files):
            if not kept or stamp - kept[-1] >= rule.min_interval_s * 1e6:
                kept.append(stamp)
        return kept

    def notes(self, recordings: Mapping[str, SensorRecordings], indexed: Mapping[str, int]) -> list[str]:
        """Sentences on what was left out and what is unusual. `indexed`: the numbers of messages by the index of a bag
        that was read as a whole."""
        every = list(recordings.values())
        begin = min(stamp for one in every for stamp in one.files)
        damaged = [f"{what} left out as damaged: {count}" for what, count in self._tree.damaged.items()]
        found = [unposed_sentence(every), grey_sentence(every), self._pose_gaps(begin), *damaged]
        return [
            *(sentence for sentence in found if sentence),
            *(note for one in every for note in one.notes(begin, indexed.get(one.name))),
        ]

    def _pose_gaps(self, begin: int) -> str | None:
        steps = np.zeros(0) if self._ego is None else np.diff(self._ego.stamps)
        if self._ego is None or not (steps > MAX_POSE_GAP).any():
            return None
        longest = int(np.argmax(steps))
        at = (self._ego.stamps[longest] - begin) * 1e-6
        count = int((steps > MAX_POSE_GAP).sum())
        return (
            f"poses of the vehicle have {count} gap{'s' if count > 1 else ''} of more than 1 s, the longest of "
            f"{steps[longest] * 1e-6:.1f} s from {at:.1f} s on"
        )
