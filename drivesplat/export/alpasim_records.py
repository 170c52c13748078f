"""The records of a scene for AlpaSim: plain data of its JSON and YAML files.

Frames: "local" is the world of `Scene`, metres, z up, whose origin is in the scene; the rig is the ego vehicle (x
forward, y left, z up, on the ground under the rear axle); cameras are OpenCV cameras. Times are the recording's
microseconds. Principal points are in continuous pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.editing.actors import other_objects
from drivesplat.editing.ego import MAX_LEAD
from drivesplat.export.sampled_motion import sample_motion
from drivesplat.io.storage import Provenance
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.shutter import readout_of
from drivesplat.settings.simulate import VehicleBody
from drivesplat.trajectories.camera_path import film_timestamps, recorded_frames, recorded_timestamps
from drivesplat.trajectories.edited_actors import EditedActor

SEQUENCE = "dummy_chunk_id"
"""The key of the one sequence of tracks: programs look for this name."""
CONTROLLABLE = "CONTROLLABLE"
"""The flag of tracks that a simulator moves."""
RATE = 30
"""Poses of the vehicle a second, besides those of images."""
EXPOSURE_US = 1000
"""The length of an image without a known readout, microseconds: AlpaSim refuses images that end when they begin."""
LEAD_US = round(1e6 * MAX_LEAD)
"""Microseconds before its first pose and after its last one in which the path of the vehicle is known."""
IDENTITY = np.eye(4).tolist()
LABELS = {
    ObjectClass.CAR: "automobile",
    ObjectClass.TRUCK: "heavy_truck",
    ObjectClass.BUS: "bus",
    ObjectClass.TRAILER: "trailer",
    ObjectClass.CONSTRUCTION_VEHICLE: "other_vehicle",
    ObjectClass.TRAM: "train_or_tram_car",
    ObjectClass.VEHICLE: "other_vehicle",
    ObjectClass.MOTORCYCLE: "rider",
    ObjectClass.BICYCLE: "rider",
    ObjectClass.RIDER: "rider",
    ObjectClass.PEDESTRIAN: "person",
    ObjectClass.ANIMAL: "animal",
    ObjectClass.OTHER_MOVABLE: "protruding_object",
}
"""The label of each class in NVIDIA's taxonomy. Datasets annotate cycles with and without a rider alike."""
SHUTTERS = {
    (0, 1): "ROLLING_TOP_TO_BOTTOM",
    (1, 0): "ROLLING_LEFT_TO_RIGHT",
    (0, -1): "ROLLING_BOTTOM_TO_TOP",
    (-1, 0): "ROLLING_RIGHT_TO_LEFT",
    (0, 0): "GLOBAL",
}
"""The shutter by the signs of the first two of `Shutter.readout_s`."""


@dataclass(frozen=True, eq=False)
class AlpasimScene:
    """What the records of a `drive` share: the scene's `id`, the images of each camera as [start, end] in microseconds,
    and the `timestamps` (n,) of the poses of the vehicle, which cover all images."""

    drive: TrainedDrive
    id: str
    images: dict[str, list[list[int]]]
    timestamps: Int64[np.ndarray, " n"]

    @classmethod
    def of(cls, drive: TrainedDrive, scene_id: str) -> "AlpasimScene":
        images = {name: times for name in drive.cameras if (times := _image_times(drive, name))}
        ends = np.array([time for own in images.values() for image in own for time in image], dtype=np.int64)
        regular = film_timestamps(int(ends.min()), int(ends.max()), RATE)
        return cls(drive, scene_id, images, np.unique(np.concatenate([ends, (ends[::2] + ends[1::2]) // 2, regular])))

    @property
    def span(self) -> tuple[int, int]:
        """The first and the last time in microseconds."""
        return int(self.timestamps[0]), int(self.timestamps[-1])

    @property
    def ego_to_world(self) -> Float64[np.ndarray, "n 4 4"]:
        """The poses of the vehicle at the timestamps."""
        return self.drive.ego_path(self.seconds(self.timestamps))

    def seconds(self, timestamps: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Timestamps as seconds since the first image."""
        return self.drive.scene.seconds(timestamps[0]) + (timestamps - timestamps[0]) * 1e-6

    def camera_key(self, name: str) -> str:
        """The unique name of a camera."""
        return f"{name}@{self.id}"


def _image_times(drive: TrainedDrive, name: str) -> list[list[int]]:
    """The begin and the end of the readout of each image of a camera, where the path of the vehicle is known, by the
    images of the first camera; without a known readout EXPOSURE_US about it."""
    sensor = next((camera for camera in drive.scene.cameras if camera.name == name), None)
    readout_us = 0 if sensor is None else round(1e6 * np.abs(readout_of(sensor)).sum())
    length, found = readout_us or EXPOSURE_US, []
    known = recorded_timestamps(drive.scene, drive.cameras[0])[[0, -1]] + [-LEAD_US, LEAD_US]
    for frame in recorded_frames(drive.scene, name):
        if not known[0] <= frame.timestamp <= known[1]:
            continue
        middle = frame.timestamp + (round(1e6 * frame.readout_middle_s) if readout_us else 0)
        found.append([middle - length // 2, middle - length // 2 + length])
    return found


def metadata(scene: AlpasimScene, scene_id: str, provenance: Provenance) -> dict[str, Any]:
    """The content of metadata.yaml. There is no date of the training: equal inputs give equal files."""
    drive = scene.drive
    start, end = scene.span
    name = f"{drive.scene.dataset}/{drive.scene.name}/{drive.folder.absolute().name}"
    return {
        "scene_id": scene_id,
        "version_string": f"drivesplat-{provenance['code_sha256'][:12]}",
        "training_date": "unknown",
        "dataset_hash": provenance["inputs_sha256"],
        "uuid": scene_id.removeprefix("clipgt-"),
        "is_resumable": False,
        "sensors": {"camera_ids": [*scene.images], "lidar_ids": drive.lidars},
        "logger": {"name": f"drivesplat {drive.where}", "run_id": name, "run_url": None},
        "time_range": {"start": start, "end": end},
        "training_step_outputs": {},
    }


def data_info(scene: AlpasimScene) -> dict[str, Any]:
    """The content of data_info.json."""
    start, end = scene.span
    return {"sequence_id": scene.id, "pose-range": {"start-timestamp_us": start, "end-timestamp_us": end}}


def rig_trajectories(scene: AlpasimScene, body: VehicleBody) -> dict[str, Any]:
    """The content of rig_trajectories.json. World, local and base frame are one."""
    centre = [0.5 * body.length - body.rear_overhang, 0.0, 0.5 * body.height]
    box = {"centroid": centre, "dim": [body.length, body.width, body.height], "rot": [0.0, 0.0, 0.0]}
    trajectory = {
        "sequence_id": scene.id,
        "T_rig_world_timestamps_us": scene.timestamps.tolist(),
        "T_rig_worlds": scene.ego_to_world.tolist(),
        "cameras_frame_timestamps_us": {scene.camera_key(name): times for name, times in scene.images.items()},
        "rig_bbox": box,
    }
    return {
        "world_to_nre": {"matrix": IDENTITY},
        "T_world_base": IDENTITY,
        "camera_calibrations": {scene.camera_key(name): _calibration(scene.drive, name) for name in scene.images},
        "rig_trajectories": [trajectory],
    }


def _calibration(drive: TrainedDrive, name: str) -> dict[str, Any]:
    """A camera at the size of its training images: without distortion, as the model renders it."""
    camera = drive.camera(name, rolling_shutter=True)
    mount, K = camera.camera_to_ego, camera.K
    assert mount is not None
    across, down = (int(np.sign(seconds)) for seconds in camera.readout_s[:2])
    parameters = {
        "resolution": [camera.width, camera.height],
        "shutter_type": SHUTTERS[across, down],
        "principal_point": [float(K[0, 2]), float(K[1, 2])],
        "focal_length": [float(K[0, 0]), float(K[1, 1])],
        "radial_coeffs": [0.0] * 6,
        "tangential_coeffs": [0.0] * 2,
        "thin_prism_coeffs": [0.0] * 4,
    }
    model = {"type": "opencv-pinhole", "parameters": parameters}
    return {"logical_sensor_name": name, "T_sensor_rig": mount.tolist(), "camera_model": model}


def sequence_tracks(scene: AlpasimScene) -> dict[str, Any]:
    """The content of sequence_tracks.json: the objects that the drive can move, flagged, at the poses at which the
    model has them, and all others as annotated. An object that is seen again after a gap has one track over it."""
    drive, columns = scene.drive, _no_tracks()
    editable = [(actor, [CONTROLLABLE]) for actor in drive.edited_actors]
    others = [(actor, []) for actor in other_objects(drive.scene, drive.edited_actors)]
    for actor, flags in (*editable, *others):
        timestamps, poses = _sampled(scene, actor)
        if len(timestamps) < 2:  # no motion: the object is there before or after all images
            continue
        columns["tracks_id"].append(actor.id)
        columns["tracks_label_class"].append(LABELS[actor.object_class])
        columns["tracks_flags"].append(flags)
        columns["tracks_timestamps_us"].append(timestamps.tolist())
        columns["tracks_poses"].append(list(_positions_and_quaternions(poses)))
        columns["cuboids_dims"].append([float(edge) for edge in actor.size])
    dims = {"cuboids_dims": columns.pop("cuboids_dims")}
    return {SEQUENCE: {"tracks_data": columns, "cuboidtracks_data": dims}}


def _no_tracks() -> dict[str, list[Any]]:
    tracks = ("id", "label_class", "flags", "timestamps_us", "poses")
    return {name: [] for name in (*(f"tracks_{track}" for track in tracks), "cuboids_dims")}


def _sampled(scene: AlpasimScene, actor: EditedActor) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 4 4"]]:
    """The times of an object within the recording, and its poses then."""
    first, last = scene.span
    motion = actor.path.trajectory.motion
    sampled = sample_motion(motion, scene.seconds(np.array([first, last])), motion.times[0])
    start = first - round(1e6 * scene.drive.scene.seconds(first))  # of the first image
    timestamps = start + np.rint(1e6 * sampled.seconds).astype(np.int64)
    inside = (first <= timestamps) & (timestamps <= last)
    return timestamps[inside], actor.poses(sampled.seconds[inside])


def _positions_and_quaternions(poses: Float64[np.ndarray, "k 4 4"]) -> Iterator[list[float]]:
    """Poses as [x, y, z, qx, qy, qz, qw]; successive quaternions are on one side, for programs that interpolate."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    turned = np.cumsum((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0.0) % 2
    quaternions[1:] *= np.where(turned, -1.0, 1.0)[:, None]
    yield from np.round(np.concatenate([poses[:, :3, 3], quaternions], axis=1), 9).tolist()
