"""Converts a log of the Argoverse 2 sensor dataset (https://argoverse.github.io/user-guide/datasets/sensor.html) to a
drive folder. LOG is the folder of a log, with calibration/, sensors/, city_SE3_egovehicle.feather and, but in the test
split, annotations.feather. A log without images becomes a drive of LiDAR alone.

Argoverse's ego frame has its origin at the centre of the rear axle, 0.33 m above the ground; that of a drive folder is
on the ground. Images are undistorted: k1, k2 and k3 describe the lens before that, and are not used. Sweeps hold the
returns of two LiDARs, motion-compensated to the sweep's time, in the ego frame: each LiDAR becomes one of the drive
folder, and its returns are given in its own frame. Boxes are annotated at the times of sweeps, which are key frames.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import ArrowException, feather
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1]))  # a checkout that is not installed

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.conversion import pose_at, reading, reported, timed_poses, warn, write_folder
from drivesplat.readers.drive.write import pose_record
from drivesplat.scene.rigid import apply, inverse, rigid

LICENCE = "Argoverse 2: CC BY-NC-SA 4.0, Wilson et al., Argoverse 2: Next Generation Datasets"
TO_GROUND = rigid(np.eye(3), np.array([0.0, 0.0, 0.33]))
"""Argoverse's ego frame in that of a drive folder (https://github.com/argoverse/argoverse-api/issues/286)."""
LIDARS = {"up_lidar": range(32), "down_lidar": range(32, 64)}
"""The lasers of each LiDAR (https://github.com/argoverse/av2-api/issues/77)."""
CLASSES = {
    "car": ["REGULAR_VEHICLE"],
    "truck": ["BOX_TRUCK", "TRUCK", "TRUCK_CAB"],
    "bus": ["BUS", "SCHOOL_BUS", "ARTICULATED_BUS"],
    "trailer": ["VEHICULAR_TRAILER"],
    "tram": ["RAILED_VEHICLE"],
    "vehicle": ["LARGE_VEHICLE"],
    "motorcycle": ["MOTORCYCLE"],
    "bicycle": ["BICYCLE"],
    "rider": ["BICYCLIST", "MOTORCYCLIST", "WHEELED_RIDER"],
    "pedestrian": ["PEDESTRIAN", "OFFICIAL_SIGNALER", "STROLLER", "WHEELCHAIR"],
    "animal": ["ANIMAL", "DOG"],
}
"""Categories by class; all others, such as cones, signs and message boards, are other_movable."""
CLASS_OF = {category: name for name, categories in CLASSES.items() for category in categories}


def table(path: Path) -> dict[str, np.ndarray]:
    """The columns of a feather file."""
    with reading(path):
        try:
            content = feather.read_table(path)
            content.validate(full=True)
            return {name: content[name].to_numpy() for name in content.column_names}
        except ArrowException as error:
            raise ValueError(str(error)) from error


def poses_of(columns: dict[str, np.ndarray]) -> np.ndarray:
    """The poses (n, 4, 4) of a table with qw, qx, qy, qz, tx_m, ty_m and tz_m."""
    quaternions = np.stack([columns[name] for name in ("qx", "qy", "qz", "qw")], axis=1)
    positions = np.stack([columns[name] for name in ("tx_m", "ty_m", "tz_m")], axis=1)
    return rigid(Rotation.from_quat(quaternions).as_matrix(), positions)


def microseconds(times_ns: np.ndarray) -> np.ndarray:
    """Times in nanoseconds as those of a drive folder."""
    return np.asarray(times_ns, dtype=np.int64) // 1000


def files_by_time(folder: Path, suffix: str) -> dict[int, Path]:
    """The files of a sensor by their time in nanoseconds, which is their name."""
    with reading(folder):
        return {int(path.stem): path for path in sorted(folder.glob(f"*{suffix}"))}


def cameras_of(log: Path, names: list[str] | None, mounts: dict[str, np.ndarray]) -> dict[str, Any]:
    """The cameras called `names`, or all ring cameras of which there are images: none in a log of LiDAR alone."""
    folders = sorted(path.name for path in (log / "sensors/cameras").glob("*") if path.is_dir())
    wanted = names or [name for name in folders if name.startswith("ring_")]
    path = log / "calibration/intrinsics.feather"
    columns, found = table(path) if wanted else {}, {}
    with reading(path):
        for i, name in enumerate(columns.get("sensor_name", ())):
            if name not in wanted or name not in folders:
                continue
            fx, fy, cx, cy = (float(columns[key][i]) for key in ("fx_px", "fy_px", "cx_px", "cy_px"))
            found[name] = {
                "width": int(columns["width_px"][i]),
                "height": int(columns["height_px"][i]),
                "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
                "sensor_to_ego": pose_record(TO_GROUND @ mounts[name]),
            }
    lacking = [name for name in wanted if name not in found]
    if lacking:
        raise DatasetError(f"{log} has no images or no intrinsics of {', '.join(lacking)}")
    if not found:
        warn(f"{log / 'sensors/cameras'} has no images of ring cameras: the drive is one of LiDAR alone")
    return found


def tracks(path: Path, ego_times: np.ndarray, ego_to_city: np.ndarray) -> Iterator[dict[str, Any]]:
    """The annotated objects; `ego_to_city` (n, 4, 4) at `ego_times` (n,), in nanoseconds. Boxes are given in the ego
    frame of their time."""
    columns = table(path)
    with reading(path):
        boxes, times = poses_of(columns), columns["timestamp_ns"]
        for track in dict.fromkeys(columns["track_uuid"]):
            rows = np.flatnonzero(columns["track_uuid"] == track)
            rows = rows[np.argsort(times[rows])]
            poses = np.stack([pose_at(ego_times, ego_to_city, times[i]) @ boxes[i] for i in rows])
            category = columns["category"][rows[0]]
            size = [float(np.median(columns[name][rows])) for name in ("length_m", "width_m", "height_m")]
            shape = {"class": CLASS_OF.get(category, "other_movable"), "category": category, "size": size}
            yield {"id": track, **shape, "poses": timed_poses(microseconds(times[rows]), poses)}


def sweep_columns(path: Path, lasers: range, mount: np.ndarray) -> dict[str, np.ndarray]:
    """The returns of a LiDAR, mounted at `mount` in Argoverse's ego frame, of a sweep's file."""
    columns = table(path)
    with reading(path):
        own = np.isin(columns["laser_number"], lasers)
        points = apply(inverse(mount), np.stack([columns[name][own].astype(float) for name in "xyz"], axis=1))
        return dict(zip("xyz", points.T.astype(np.float32), strict=True)) | {
            "intensity": columns["intensity"][own].astype(np.float32) / 255.0,
            "ring": columns["laser_number"][own].astype(np.int64) - lasers.start,
            "time": columns["offset_ns"][own] * 1e-9,
        }


def convert(log: Path, out: Path, cameras: list[str] | None) -> Path:
    """Writes the drive folder; returns the path of its drive.json."""
    columns = table(log / "calibration/egovehicle_SE3_sensor.feather")
    with reading(log / "calibration/egovehicle_SE3_sensor.feather"):
        mounts = dict(zip(columns["sensor_name"], poses_of(columns), strict=True))
    columns = table(log / "city_SE3_egovehicle.feather")
    with reading(log / "city_SE3_egovehicle.feather"):
        ego_times, rows = np.unique(columns["timestamp_ns"], return_index=True)
        ego_to_city = poses_of(columns)[rows]
    distinct = np.unique(microseconds(ego_times), return_index=True)[1]

    mounted = cameras_of(log, cameras, mounts)
    images = {name: files_by_time(log / "sensors/cameras" / name, ".jpg") for name in mounted}
    scans = files_by_time(log / "sensors/lidar", ".feather")
    lidars = {name: lasers for name, lasers in LIDARS.items() if name in mounts}
    boxes = log / "annotations.feather"
    record = {
        "format": "drivesplat drive",
        "version": 1,
        "description": f"Argoverse 2 {log.resolve().name}",
        "licence": LICENCE,
        "cameras": mounted,
        "lidars": {
            name: {"sensor_to_ego": pose_record(TO_GROUND @ mounts[name]), "revolution_s": 0.1} for name in lidars
        },
        "ego_poses": timed_poses(microseconds(ego_times)[distinct], (ego_to_city @ inverse(TO_GROUND))[distinct]),
        "key_frames": microseconds(list(scans)).tolist() or None,
        "frames": [
            {"camera": name, "timestamp": time // 1000, "file": f"{name}/{path.name}"}
            for name, files in images.items()
            for time, path in files.items()
        ],
        "sweeps": [
            {"lidar": name, "timestamp": time // 1000, "file": f"{name}/{time}.npz"}
            for name in lidars
            for time in scans
        ],
        "tracks": list(tracks(boxes, ego_times, ego_to_city)) if boxes.is_file() else [],
    }
    sources = {f"{name}/{path.name}": path for name, files in images.items() for path in files.values()}
    sweeps = (
        (f"{name}/{time}.npz", sweep_columns(path, lasers, mounts[name]))
        for name, lasers in lidars.items()
        for time, path in scans.items()
    )
    return write_folder(out, record, sources, sweeps)


def main(arguments: list[str] | None = None) -> int:
    """Converts a log; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, help="folder of a log")
    parser.add_argument("out", type=Path, help="the drive folder, new or empty")
    parser.add_argument("--cameras", nargs="+", help="names of cameras; by default the seven ring cameras")
    asked = parser.parse_args(arguments)
    return reported("argoverse2", lambda: convert(asked.log, asked.out, asked.cameras))


if __name__ == "__main__":
    sys.exit(main())
