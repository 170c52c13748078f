"""Converts a drive of KITTI raw ("synced+rectified", https://www.cvlibs.net/datasets/kitti/raw_data.php) to a drive
folder. DATE is the folder of a day, with calib_cam_to_cam.txt, calib_velo_to_cam.txt, calib_imu_to_velo.txt and the
drives; DRIVE is a drive's number, such as 0001.

The ego frame is that of the GPS/IMU unit, lowered to the ground. The unit is mounted within decimetres of the rear
axle's centre. Poses are the unit's, in Mercator's projection with the scale of the first latitude, as in KITTI's
development kit. Boxes are those of tracklet_labels.xml, if it is there.

KITTI's readme: "the velodyne scanner takes depth measurements continuously while rotating [...] you have to 'untwist'
the points linearly", and cameras are triggered when it looks forward. Scans are therefore untwisted here to the time at
which the scanner faces forward. The readme says that the scanner "rotates in counter-clockwise direction"; the scans
themselves fit each other best if it turns clockwise (docs/own_data.md), as KISS-ICP's loader takes them. Some users
report scans that are compensated already: compare the edges of poles in check.png, and choose with --scans.
"""

import argparse
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1]))  # a checkout that is not installed

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.conversion import pose_at, reading, reported, timed_poses, write_folder
from drivesplat.readers.drive.write import pose_record
from drivesplat.scene.rigid import apply, inverse, rigid

LICENCE = "KITTI: CC BY-NC-SA 3.0, Geiger et al., Vision meets Robotics: The KITTI Dataset"
MISSING = -1
"""The time of a lost recording."""
COLOUR = ("02", "03")
EARTH_RADIUS = 6378137.0
IMU_TO_EGO = rigid(np.eye(3), np.array([0.0, 0.0, 0.93]))
"""The GPS/IMU unit is 0.93 m above the ground (sensor setup, https://www.cvlibs.net/datasets/kitti/setup.php)."""
CLASSES = {
    "Car": "car", "Van": "car", "Truck": "truck", "Tram": "tram", "Cyclist": "rider", "Pedestrian": "pedestrian",
    "Person (sitting)": "pedestrian", "Misc": "vehicle",
}  # fmt: skip
"""'Misc' holds trailers, Segways and the like."""
VISIBLE_SHARE = {0: 0.9, 1: 0.5, 2: 0.1}
"""Of an object by its occlusion: not, partly, fully. Other values are unset."""


def calibration(path: Path) -> dict[str, np.ndarray]:
    """The numbers of a calibration file by their names."""
    with reading(path):
        lines = (line.partition(":") for line in path.read_text().splitlines() if ":" in line)
        return {name: np.array(values.split(), dtype=float) for name, _, values in lines if name != "calib_time"}


def transform(path: Path) -> np.ndarray:
    """The transform (4, 4) of a calibration file with R and T."""
    values = calibration(path)
    with reading(path):
        return rigid(values["R"].reshape(3, 3), values["T"].reshape(3))


def timestamps(path: Path) -> np.ndarray:
    """The times (n,) in microseconds of a file with a time per line, such as 2011-09-26 13:02:25.964389445; MISSING for
    an empty line, which stands for a lost recording."""
    with reading(path):
        times = np.array([line.strip() or "NaT" for line in path.read_text().splitlines()], dtype="datetime64[ns]")
    return np.where(np.isnat(times), MISSING, times.astype(np.int64) // 1000)


def recordings(folder: Path, suffix: str) -> list[tuple[int, int, Path]]:
    """Of each file of a sensor: its index, which is a line of timestamps.txt, its time, and its path. A drive may lack
    some."""
    times, files = timestamps(folder / "timestamps.txt"), sorted((folder / "data").glob(f"*{suffix}"))
    if not files:
        raise DatasetError(f"{folder / 'data'} holds no {suffix} files")
    with reading(folder / "timestamps.txt"):
        return [(int(path.stem), int(times[int(path.stem)]), path) for path in files]


def imu_poses(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The times (n,) and the poses (n, 4, 4) of the GPS/IMU unit: x east, y north, z up."""
    records, rows = recordings(folder, ".txt"), []
    for _, _, path in records:
        with reading(path):
            rows.append([float(value) for value in path.read_text().split()[:6]])
    latitude, longitude, altitude, roll, pitch, yaw = np.array(rows).T
    scale = EARTH_RADIUS * np.cos(np.radians(latitude[0]))
    east = scale * np.radians(longitude)
    north = scale * np.log(np.tan(np.radians(90.0 + latitude) / 2))
    rotations = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_matrix()
    return np.array([time for _, time, _ in records]), rigid(rotations, np.stack([east, north, altitude], axis=1))


def camera(values: dict[str, np.ndarray], number: str, imu_to_velo: np.ndarray, velo_to_cam: np.ndarray) -> dict:
    """A rectified colour camera. P_rect = K [I | t]: t shifts camera 0's rectified frame to this camera's."""
    projection = values[f"P_rect_{number}"].reshape(3, 4)
    K, rectifying = projection[:, :3], rigid(values["R_rect_00"].reshape(3, 3), np.zeros(3))
    shift = rigid(np.eye(3), np.linalg.solve(K, projection[:, 3]))
    imu_to_camera = shift @ rectifying @ velo_to_cam @ imu_to_velo
    width, height = values[f"S_rect_{number}"].astype(int).tolist()
    mount = pose_record(IMU_TO_EGO @ inverse(imu_to_camera))
    return {"width": width, "height": height, "K": K.tolist(), "sensor_to_ego": mount}


def untwisted(points: np.ndarray, scans: str, start: np.ndarray, end: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """The points (n, 3) of a scan as seen from the pose `forward`; the scanner turned once from `start` to `end`, from
    behind the vehicle to behind it. Poses are scanner to world (4, 4)."""
    if scans == "compensated":
        return points
    azimuth = np.arctan2(points[:, 1], points[:, 0]) * (1 if scans == "counter-clockwise" else -1)
    shares = (azimuth[:, None] + np.pi) / (2 * np.pi)
    motion = inverse(start) @ end
    turns = Rotation.from_rotvec(shares * Rotation.from_matrix(motion[:3, :3]).as_rotvec())
    return apply(inverse(forward) @ start, turns.apply(points) + shares * motion[:3, 3])


def sweep_columns(path: Path, scans: str, start: np.ndarray, end: np.ndarray, forward: np.ndarray) -> dict[str, Any]:
    """The untwisted returns of a scan's file: x, y, z, reflectance."""
    with reading(path):
        *points, reflectance = np.frombuffer(path.read_bytes(), dtype=np.float32).reshape(-1, 4).T
    at_forward = untwisted(np.stack(points, axis=1).astype(float), scans, start, end, forward)
    return dict(zip("xyz", at_forward.T.astype(np.float32), strict=True)) | {"intensity": reflectance.clip(0.0, 1.0)}


def tracks(path: Path, scanner_poses: np.ndarray, times: np.ndarray) -> Iterator[dict[str, Any]]:
    """The tracklets of a drive; `scanner_poses` (n, 4, 4) and `times` (n,) are those of its scans. Tracklets stand on
    the bottom of their boxes."""
    with reading(path):
        for number, item in enumerate(ElementTree.parse(path).getroot().findall("tracklets/item")):
            kind, first = item.findtext("objectType", "").strip(), int(item.findtext("first_frame", ""))
            height, width, length = (float(item.findtext(name, "")) for name in ("h", "w", "l"))
            poses = []
            for index, pose in enumerate(item.findall("poses/item"), first):
                if times[index] == MISSING:
                    continue
                x, y, z, *angles = (float(pose.findtext(name, "")) for name in ("tx", "ty", "tz", "rx", "ry", "rz"))
                box = rigid(Rotation.from_euler("xyz", angles).as_matrix(), np.array([x, y, z + height / 2]))
                share = VISIBLE_SHARE.get(int(pose.findtext("occlusion", "-1")))
                seen = {"timestamp": int(times[index]), "visibility": share}
                poses.append(seen | pose_record(scanner_poses[index] @ box))
            shape = {"class": CLASSES[kind], "category": kind, "size": [length, width, height]}
            if poses:
                yield {"id": f"tracklet_{number}", **shape, "poses": poses}


def convert(date: Path, drive: str, out: Path, cameras: list[str] | None, scans: str) -> Path:
    """Writes the drive folder; returns the path of its drive.json."""
    folder = date / f"{date.resolve().name}_drive_{drive.zfill(4)}_sync"
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}; name the folder of a day and the number of one of its drives")
    imu_to_velo, velo_to_cam = (transform(date / f"calib_{name}.txt") for name in ("imu_to_velo", "velo_to_cam"))
    values = calibration(date / "calib_cam_to_cam.txt")
    imu_times, imu_to_world = imu_poses(folder / "oxts")

    numbers = cameras or [number for number in COLOUR if (folder / f"image_{number}").is_dir()]
    with reading(date / "calib_cam_to_cam.txt"):
        mounted = {f"image_{number}": camera(values, number, imu_to_velo, velo_to_cam) for number in numbers}
    frames, images = [], {}
    for name in mounted:
        for _, time, path in recordings(folder / name, ".png"):
            ego = pose_record(pose_at(imu_times, imu_to_world, time) @ inverse(IMU_TO_EGO))
            frames.append({"camera": name, "timestamp": time, "file": f"{name}/{path.name}", "ego_to_world": ego})
            images[f"{name}/{path.name}"] = path

    def scanner_at(time: np.integer) -> np.ndarray:
        return pose_at(imu_times, imu_to_world, time) @ inverse(imu_to_velo)

    velodyne = folder / "velodyne_points"
    starts, forwards, ends = (timestamps(velodyne / f"timestamps{name}.txt") for name in ("_start", "", "_end"))
    scanner_poses = np.stack([np.eye(4) if time == MISSING else scanner_at(time) for time in forwards])
    scan_files = recordings(velodyne, ".bin")

    sweeps = (
        (f"velodyne/{path.stem}.npz", sweep_columns(path, scans, scanner_at(starts[i]), scanner_at(ends[i]), forward))
        for (i, _, path), forward in zip(scan_files, scanner_poses[[i for i, *_ in scan_files]], strict=True)
    )
    labels = folder / "tracklet_labels.xml"
    record = {
        "format": "drivesplat drive",
        "version": 1,
        "description": f"KITTI raw {folder.name}",
        "licence": LICENCE,
        "cameras": mounted,
        "lidars": {"velodyne": {"sensor_to_ego": pose_record(IMU_TO_EGO @ inverse(imu_to_velo)), "revolution_s": 0.1}},
        "ego_poses": timed_poses(imu_times, imu_to_world @ inverse(IMU_TO_EGO)),
        "frames": frames,
        "sweeps": [
            {
                "lidar": "velodyne",
                "timestamp": time,
                "file": f"velodyne/{path.stem}.npz",
                "lidar_to_world": pose_record(scanner_poses[i]),
            }
            for i, time, path in scan_files
        ],
        "tracks": list(tracks(labels, scanner_poses, forwards)) if labels.is_file() else [],
    }
    return write_folder(out, record, images, sweeps)


def main(arguments: list[str] | None = None) -> int:
    """Converts a drive; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("date", type=Path, help="folder of a day, such as ~/kitti/2011_09_26")
    parser.add_argument("drive", help="number of a drive, such as 0001")
    parser.add_argument("out", type=Path, help="the drive folder, new or empty")
    parser.add_argument("--cameras", nargs="+", choices=COLOUR, help="colour cameras; by default those there are")
    directions = ["clockwise", "counter-clockwise", "compensated"]
    parser.add_argument("--scans", default=directions[0], choices=directions, help="direction in which scans turn")
    asked = parser.parse_args(arguments)
    return reported("kitti_raw", lambda: convert(asked.date, asked.drive, asked.out, asked.cameras, asked.scans))


if __name__ == "__main__":
    sys.exit(main())
