"""Converts a log of py123d (https://github.com/autonomousvision/py123d, version 0.7) to a drive folder: Argoverse 2,
PandaSet, KITTI-360, nuPlan, and what else py123d reads.

It runs in an environment of py123d, whose packages differ from drivesplat's, and imports nothing of drivesplat. DATA is
the folder with py123d's logs/ and maps/ (PY123D_DATA_ROOT), LOG the name of a log. Check the result with
`drivesplat check OUT`.

The ego frame is py123d's rear axle, lowered to the ground by --axle-height. Points are those of each LiDAR in its own
frame; py123d gives them in the IMU's. They are taken as motion-compensated to the beginning of their sweep, unless
--uncompensated says that they are where the LiDAR saw them, each at its own time. KITTI-360's are not compensated, and
py123d has no times of them. Images are written as PNG, since py123d decodes them.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

LICENCES = {
    "av2": "Argoverse 2: CC BY-NC-SA 4.0 (https://www.argoverse.org/about.html)",
    "pandaset": "PandaSet: CC BY 4.0 and its terms of use (https://pandaset.org)",
    "kitti360": "KITTI-360: CC BY-NC-SA 3.0 (https://www.cvlibs.net/datasets/kitti-360)",
    "nuplan": "nuPlan: CC BY-NC-SA 4.0 and its terms of use (https://www.nuscenes.org/terms-of-use)",
}
"""By the beginning of the dataset's name in py123d."""
CLASSES = {
    "car": "CAR REGULAR_VEHICLE VEHICLE_CAR AUTOMOBILE CARAVAN",
    "truck": "TRUCK BOX_TRUCK TRUCK_CAB LARGE_VEHICLE PICKUP_TRUCK MEDIUM_SIZED_TRUCK SEMI_TRUCK VEHICLE_TRUCK "
    "HEAVY_TRUCK",
    "bus": "BUS SCHOOL_BUS ARTICULATED_BUS VEHICLE_BUS VEHICLE_BUS_BENDY VEHICLE_BUS_RIGID TROLLEY_BUS",
    "trailer": "TRAILER VEHICULAR_TRAILER TOWED_OBJECT VEHICLE_TRAILER",
    "construction_vehicle": "OTHER_VEHICLE_CONSTRUCTION_VEHICLE VEHICLE_CONSTRUCTION",
    "tram": "TRAIN TRAM_SUBWAY RAILED_VEHICLE TRAIN_OR_TRAM_CAR",
    "vehicle": "VEHICLE EMERGENCY_VEHICLE OTHER_VEHICLE_UNCOMMON OTHER_VEHICLE_PEDICAB OTHER_VEHICLE TYPE_VEHICLE "
    "PERSONAL_MOBILITY_DEVICE VEHICLE_EMERGENCY_AMBULANCE VEHICLE_EMERGENCY_POLICE",
    "motorcycle": "MOTORCYCLE MOTORIZED_SCOOTER VEHICLE_MOTORCYCLE",
    "bicycle": "BICYCLE VEHICLE_BICYCLE",
    "rider": "BICYCLIST MOTORCYCLIST WHEELED_RIDER RIDER TYPE_CYCLIST",
    "pedestrian": "PEDESTRIAN PEDESTRIAN_WITH_OBJECT PERSON OFFICIAL_SIGNALER TYPE_PEDESTRIAN HUMAN HUMAN_PEDESTRIAN "
    "HUMAN_PEDESTRIAN_ADULT HUMAN_PEDESTRIAN_CHILD HUMAN_PEDESTRIAN_CONSTRUCTION_WORKER "
    "HUMAN_PEDESTRIAN_POLICE_OFFICER",
    "animal": "ANIMAL DOG ANIMALS_BIRD ANIMALS_OTHER",
}
"""Names of the datasets' own labels by class; all others are other_movable."""
MERGED = "lidar_merged"
"""The name of all LiDARs together."""
CLASS_OF = {label: name for name, labels in CLASSES.items() for label in labels.split()}


class ConversionError(Exception):
    """What a log lacks, in a sentence."""


def pose_record(matrix: np.ndarray) -> dict[str, Any]:
    """A pose (4, 4) as drive.json has it, with the rotation as a matrix."""
    return {"translation": matrix[:3, 3].tolist(), "rotation": matrix[:3, :3].tolist()}


def matrix_of(pose: Any) -> np.ndarray:
    """A PoseSE3 as a matrix (4, 4)."""
    return np.asarray(pose.transformation_matrix, dtype=np.float64)


def camera_record(metadata: Any, ego_to_imu: np.ndarray) -> dict[str, Any] | None:
    """A camera's calibration; None for a model that drive folders do not have."""
    found = {"width": int(metadata.width), "height": int(metadata.height)}
    found["sensor_to_ego"] = pose_record(np.linalg.inv(ego_to_imu) @ matrix_of(metadata.camera_to_imu_se3))
    model = metadata.camera_model.name
    if model == "PINHOLE" and metadata.intrinsics is not None:
        of = metadata.intrinsics
        found["K"] = [[of.fx, 0.0, of.cx], [0.0, of.fy, of.cy], [0.0, 0.0, 1.0]]
        lens = metadata.distortion
        if lens is not None and not metadata.is_undistorted:
            found["distortion"] = {"model": "opencv", "coefficients": [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]}
        return found
    if model == "FISHEYE_MEI" and metadata.projection is not None and metadata.mirror_parameter is not None:
        of, lens = metadata.projection, metadata.distortion
        found["K"] = [[of.gamma1, 0.0, of.u0], [0.0, of.gamma2, of.v0], [0.0, 0.0, 1.0]]
        more = [0.0] * 4 if lens is None else [lens.k1, lens.k2, lens.p1, lens.p2]
        found["distortion"] = {"model": "mei", "coefficients": [metadata.mirror_parameter, *more]}
        return found
    return None


def frames_of(scene: Any, camera: Any, name: str, out: Path) -> Iterator[dict[str, Any]]:
    """Writes the images of a camera; their records."""
    for time in scene.get_all_camera_timestamps(camera):
        image = scene.get_camera_at_timestamp(time, camera)
        if image is None:
            continue
        file = f"{name}/{time.time_us}.png"
        (out / name).mkdir(exist_ok=True)
        Image.fromarray(np.asarray(image.image)).save(out / file)
        pose = pose_record(matrix_of(image.camera_to_global_se3))
        yield {"camera": name, "timestamp": int(time.time_us), "file": file, "camera_to_world": pose}


def sweeps_of(
    scene: Any, lidar: Any, name: str, lidar_to_imu: np.ndarray, known: tuple[int, int], out: Path
) -> Iterator[dict[str, Any]]:
    """Writes the sweeps of a LiDAR in its own frame, at times at which poses are `known`; their records. Most logs hold
    those of all LiDARs in one."""
    for time in scene.get_all_lidar_timestamps(lidar) or scene.get_all_lidar_timestamps(MERGED):
        sweep = scene.get_lidar_at_timestamp(time, lidar)
        if sweep is None or not len(sweep.xyz) or not known[0] <= time.time_us <= known[1]:
            continue
        to_sensor = np.linalg.inv(lidar_to_imu)
        points = np.asarray(sweep.xyz, dtype=np.float64) @ to_sensor[:3, :3].T + to_sensor[:3, 3]
        columns = dict(zip("xyz", points.T.astype(np.float32), strict=True))
        if sweep.intensity is not None:
            columns["intensity"] = (sweep.intensity / 255.0).astype(np.float32)
        if sweep.channel is not None:
            columns["ring"] = sweep.channel.astype(np.int16)
        if sweep.timestamps is not None:
            columns["time"] = (sweep.timestamps - time.time_us) * 1e-6
        file = f"{name}/{time.time_us}.npz"
        (out / name).mkdir(exist_ok=True)
        np.savez_compressed(out / file, **columns)
        yield {"lidar": name, "timestamp": int(time.time_us), "file": file}


def tracks_of(scene: Any) -> tuple[list[dict[str, Any]], list[int]]:
    """The annotated objects, each with its median size, and the times of annotations in microseconds."""
    found: dict[str, dict[str, Any]] = {}
    sizes: dict[str, list[list[float]]] = {}
    times = scene.get_all_box_detections_se3_timestamps()
    for time in times:
        for box in scene.get_box_detections_se3_at_timestamp(time) or ():
            label, token = box.attributes.label.name, str(box.attributes.track_token)
            shape = box.bounding_box_se3
            track = {"id": token, "class": CLASS_OF.get(label, "other_movable"), "category": label.lower(), "poses": []}
            pose = {"timestamp": int(time.time_us), **pose_record(matrix_of(shape.center_se3))}
            found.setdefault(token, track)["poses"].append(pose)
            sizes.setdefault(token, []).append([shape.length, shape.width, shape.height])
    tracks = [{**track, "size": np.median(sizes[token], axis=0).tolist()} for token, track in found.items()]
    return tracks, [int(time.time_us) for time in times]


def convert(scene: Any, out: Path, axle_height: float, cameras: list[str] | None, compensated: bool) -> Path:
    """Writes the drive folder of a scene; returns the path of its drive.json."""
    vehicle = scene.get_ego_state_se3_metadata()
    if vehicle is None or not scene.get_all_ego_state_se3_timestamps():
        raise ConversionError("the log has no poses of the vehicle; convert it again with py123d")
    lowered = np.eye(4)
    lowered[2, 3] = -axle_height
    ego_to_imu = matrix_of(vehicle.rear_axle_to_imu_se3) @ lowered
    out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()):
        raise ConversionError(f"{out} is not empty; name a new folder")
    log = scene.get_log_metadata()
    record: dict[str, Any] = {
        "format": "drivesplat drive", "version": 1,
        "description": f"{log.dataset} {log.log_name}, converted from py123d",
        "licence": next((text for name, text in LICENCES.items() if log.dataset.startswith(name)), ""),
        "cameras": {}, "lidars": {}, "ego_poses": [], "frames": [], "sweeps": [],
    }  # fmt: skip
    for time in scene.get_all_ego_state_se3_timestamps():
        pose = matrix_of(scene.get_ego_state_se3_at_timestamp(time).imu_se3) @ ego_to_imu
        record["ego_poses"].append({"timestamp": int(time.time_us), **pose_record(pose)})
    known = {identity.name.lower(): (identity, of) for identity, of in scene.get_camera_metadatas().items()}
    for name in cameras or sorted(known):
        if name not in known:
            raise ConversionError(f"the log has no camera {name}; there are: {', '.join(sorted(known)) or 'none'}")
        identity, metadata = known[name]
        if (calibration := camera_record(metadata, ego_to_imu)) is None:
            print(f"warning: camera {name} has no pinhole or MEI calibration; it is left out", file=sys.stderr)
            continue
        if frames := list(frames_of(scene, identity, name, out)):
            record["cameras"][name] = calibration
            record["frames"] += frames
    for identity, metadata in scene.get_lidar_metadatas().items():
        name, lidar_to_imu = identity.name.lower(), matrix_of(metadata.lidar_to_imu_se3)
        ends = record["ego_poses"][0]["timestamp"], record["ego_poses"][-1]["timestamp"]
        sweeps = list(sweeps_of(scene, identity, name, lidar_to_imu, ends, out))
        if sweeps:
            timed = "time" in np.load(out / sweeps[0]["file"])
            mount = pose_record(np.linalg.inv(ego_to_imu) @ lidar_to_imu)
            if not compensated and not timed:
                raise ConversionError(
                    f"returns of {name} have no times, without which they cannot be moved; leave out --uncompensated"
                )
            record["lidars"][name] = {"sensor_to_ego": mount, "motion_compensated": compensated}
            record["sweeps"] += sweeps
    record["tracks"], times = tracks_of(scene)
    if times:
        record["key_frames"] = times
    path = out / "drive.json"
    path.write_text(json.dumps(record), encoding="utf-8")
    return path


def scene_of(data: Path, log: str) -> Any:
    """A whole log of py123d's data as one scene."""
    from py123d.api import SceneFilter, get_filtered_scenes

    found = get_filtered_scenes(SceneFilter(log_names=[log]), data_root=data)
    if not found:
        raise ConversionError(f"there is no log {log} in {data / 'logs'}; convert it with py123d-conversion")
    return max(found, key=lambda scene: scene.number_of_iterations)


def main(arguments: list[str] | None = None) -> int:
    """Converts a log; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with py123d's logs/ and maps/")
    parser.add_argument("log", help="name of a log")
    parser.add_argument("out", type=Path, help="the drive folder, new or empty")
    parser.add_argument("--axle-height", type=float, default=0.33, help="metres of the rear axle above ground (0.33)")
    parser.add_argument("--cameras", nargs="+", help="names of cameras, such as pcam_f0; by default all")
    parser.add_argument("--uncompensated", action="store_true", help="points are where the LiDAR saw them")
    asked = parser.parse_args(arguments)
    try:
        scene = scene_of(asked.data, asked.log)
        print(convert(scene, asked.out, asked.axle_height, asked.cameras, not asked.uncompensated))
    except ImportError as error:
        print(f"py123d_drive: py123d cannot be imported ({error}); pip install 'py123d==0.7.*' there", file=sys.stderr)
        return 1
    except ConversionError as error:
        print(f"py123d_drive: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
