"""Converts a drive of KITTI raw ("synced+rectified", https://www.cvlibs.net/datasets/kitti/raw_data.php) to a drive
folder. DATE is the folder of a day, with calib_cam_to_cam.txt, calib_velo_to_cam.txt, calib_imu_to_velo.txt and the
drives; DRIVE is a drive's number, such as 0001.

The ego frame is that of the GPS/IMU unit, lowered to the ground. The unit is mounted within decimetres of the rear
axle's centre. Poses are the unit's, in Mercator's projection with the scale of the first latitude, as in KITTI's
development kit. Boxes are those of tracklet_labels.xml, if it is there. Rings follow from the order of returns in a
scan's file, times from their azimuths, and the elevation of a beam is the median of its returns.

KITTI's readme: "the velodyne scanner takes depth measurements continuously while rotating [...] you have to 'untwist'
the points linearly", and cameras are triggered when it looks forward. Scans are therefore untwisted here to the time at
which the scanner faces forward. The readme says that the scanner "rotates in counter-clockwise direction"; the scans
themselves fit each other best if it turns clockwise (docs/own_data.md), as KISS-ICP's loader takes them. Some users
report scans that are compensated already: compare the edges of poles in check.png, and choose with --scans.
"""

import argparse
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1]))  # a checkout that is not installed

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import checked_intrinsics, checked_transform
from drivesplat.readers.drive.conversion import numbers_of, pose_at, reading, reported, timed_poses, warn, write_folder
from drivesplat.readers.drive.write import pose_record
from drivesplat.scene.rigid import inverse, rigid
from examples.kitti_files import MISSING, calibration, imu_poses, recordings, timestamps, transform
from examples.kitti_scans import RINGS, beams_of, laps_of, read_scan, rings_of, scan_times, shares_of, untwisted

LICENCE = "KITTI: CC BY-NC-SA 3.0, Geiger et al., Vision meets Robotics: The KITTI Dataset"
COLOUR = ("02", "03")
IMU_TO_EGO = rigid(np.eye(3), np.array([0.0, 0.0, 0.93]))
"""The GPS/IMU unit is 0.93 m above the ground (sensor setup, https://www.cvlibs.net/datasets/kitti/setup.php)."""
CLASSES = {
    "Car": "car", "Van": "car", "Truck": "truck", "Tram": "tram", "Cyclist": "rider", "Pedestrian": "pedestrian",
    "Person (sitting)": "pedestrian", "Misc": "vehicle",
}  # fmt: skip
"""'Misc' holds trailers, Segways and the like."""
VISIBLE_SHARE = {"0": 0.9, "1": 0.5, "2": 0.1}
"""Of an object by its occlusion: not, partly, fully. Other values are unset."""
Odd = dict[str, list[str]]
"""Names of scans by what is unusual about them."""
NO_RINGS = "have returns in another order than ring by ring; they get no ring, which methods that render LiDAR need"
BY_ELEVATION = (
    f"have another number of rings than {RINGS}; each ring of theirs is taken for that of the nearest elevation"
)


def camera(path: Path, number: str, imu_to_velo: np.ndarray, velo_to_cam: np.ndarray) -> dict[str, Any]:
    """A rectified colour camera. P_rect = K [I | t]: t shifts camera 0's rectified frame to this camera's."""
    size, matrix = f"S_rect_{number}", f"P_rect_{number}"
    values = calibration(path, **{size: 2, matrix: 12, "R_rect_00": 9})
    projection, rotation = values[matrix].reshape(3, 4), rigid(values["R_rect_00"].reshape(3, 3), np.zeros(3))
    width, height = (int(value) for value in values[size])
    K = checked_intrinsics(projection[:, :3], f"{path}: {matrix}", (width, height))
    shift = rigid(np.eye(3), np.linalg.solve(K, projection[:, 3]))
    imu_to_camera = shift @ checked_transform(rotation, f"{path}: R_rect_00") @ velo_to_cam @ imu_to_velo
    mount = pose_record(IMU_TO_EGO @ inverse(imu_to_camera))
    return {"width": width, "height": height, "K": K.tolist(), "sensor_to_ego": mount}


def sweep_columns(
    path: Path, scans: str, times: Sequence[int], poses: list[np.ndarray], beams: np.ndarray | None, odd: Odd
) -> dict[str, Any]:
    """The columns of a scan's file. `times` in microseconds and scanner poses (4, 4) are those at the start, when the
    scanner faces forward, and at the end. Adds the scan to `odd` if its returns have an unusual order."""
    points, reflectance = read_scan(path)
    start, forward, end = times
    at_forward = untwisted(points, scans, poses[0], poses[2], poses[1])
    seconds = (start - forward + shares_of(points, scans) * (end - start)) * 1e-6
    columns = dict(zip("xyz", at_forward.T.astype(np.float32), strict=True))
    columns |= {"intensity": reflectance.astype(np.float32), "time": seconds.astype(np.float32)}
    rings = None if beams is None else rings_of(points, beams)
    if rings is None:
        odd.setdefault(NO_RINGS, []).append(path.name)
        return columns
    if laps_of(points)[-1] != RINGS - 1:
        odd.setdefault(BY_ELEVATION, []).append(path.name)
    return columns | {"ring": rings.astype(np.int16)}


def tracks(path: Path, scanner_poses: np.ndarray, times: np.ndarray) -> Iterator[dict[str, Any]]:
    """The tracklets of a drive; `scanner_poses` (n, 4, 4) and `times` (n,) are those of its scans. Tracklets stand on
    the bottom of their boxes."""
    with reading(path):
        items = ElementTree.parse(path).getroot().findall("tracklets/item")
    for number, item in enumerate(items):
        record = f"{path}: tracklet {number}"
        kind, first = item.findtext("objectType", "").strip(), item.findtext("first_frame", "").strip()
        boxes = item.findall("poses/item")
        if kind not in CLASSES:
            raise DatasetError(f"{record}: its objectType is {kind[:40]!r}; known are {', '.join(CLASSES)}")
        if not first.isdecimal() or int(first) + len(boxes) > len(times):
            raise DatasetError(
                f"{record}: its first_frame is {first[:40]!r}, with {len(boxes)} poses in {len(times)} scans"
            )
        height, width, length = numbers_of(" ".join(item.findtext(name, "") for name in "hwl"), 3, f"{record}: h, w, l")
        poses = []
        for index, pose in enumerate(boxes, int(first)):
            if times[index] == MISSING:
                continue
            values = " ".join(pose.findtext(name, "") for name in ("tx", "ty", "tz", "rx", "ry", "rz"))
            x, y, z, *angles = numbers_of(values, 6, f"{record}: pose {index - int(first)}: tx, ty, tz, rx, ry, rz")
            box = rigid(Rotation.from_euler("xyz", angles).as_matrix(), np.array([x, y, z + height / 2]))
            seen = {"timestamp": int(times[index]), "visibility": VISIBLE_SHARE.get(pose.findtext("occlusion", ""))}
            poses.append(seen | pose_record(scanner_poses[index] @ box))
        if poses:
            shape = {"class": CLASSES[kind], "category": kind, "size": [length, width, height]}
            yield {"id": f"tracklet_{number}", **shape, "poses": poses}


def convert(date: Path, drive: str, out: Path, cameras: list[str] | None, scans: str) -> Path:
    """Writes the drive folder; returns the path of its drive.json."""
    folder = date / f"{date.resolve().name}_drive_{drive.zfill(4)}_sync"
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}; name the folder of a day and the number of one of its drives")
    imu_to_velo, velo_to_cam = (transform(date / f"calib_{name}.txt") for name in ("imu_to_velo", "velo_to_cam"))
    imu_times, imu_to_world = imu_poses(folder / "oxts")

    numbers = cameras or [number for number in COLOUR if (folder / f"image_{number}").is_dir()]
    if not numbers:
        warn(f"{folder} has no image_{' and no image_'.join(COLOUR)}: the drive is one of LiDAR alone")
    rectified = date / "calib_cam_to_cam.txt"
    mounted = {f"image_{number}": camera(rectified, number, imu_to_velo, velo_to_cam) for number in numbers}
    frames, images = [], {}
    for name in mounted:
        for _, time, path in recordings(folder / name, ".png"):
            ego = pose_record(pose_at(imu_times, imu_to_world, time) @ inverse(IMU_TO_EGO))
            frames.append({"camera": name, "timestamp": time, "file": f"{name}/{path.name}", "ego_to_world": ego})
            images[f"{name}/{path.name}"] = path

    def scanner_at(time: int | np.integer) -> np.ndarray:
        return pose_at(imu_times, imu_to_world, time) @ inverse(imu_to_velo)

    velodyne = folder / "velodyne_points"
    scan_files, forwards = recordings(velodyne, ".bin"), timestamps(velodyne / "timestamps.txt")
    spans = scan_times(velodyne, scan_files)
    beams, odd = beams_of(path for *_, path in scan_files), Odd()
    sweeps = (
        (f"velodyne/{path.stem}.npz", sweep_columns(path, scans, span, [scanner_at(time) for time in span], beams, odd))
        for (*_, path), span in zip(scan_files, spans, strict=True)
    )
    scanner_poses = np.stack([np.eye(4) if time == MISSING else scanner_at(time) for time in forwards])
    labels = folder / "tracklet_labels.xml"
    record = {
        "format": "drivesplat drive",
        "version": 1,
        "description": f"KITTI raw {folder.name}",
        "licence": LICENCE,
        "cameras": mounted,
        "lidars": {
            "velodyne": {
                "sensor_to_ego": pose_record(IMU_TO_EGO @ inverse(imu_to_velo)),
                "beam_elevations": None if beams is None else beams.tolist(),
                "revolution_s": 0.1,
            }
        },
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
    written = write_folder(out, record, images, sweeps)
    for how, names in odd.items():
        warn(f"{len(names)} of {len(scan_files)} scans (first: {names[0]}) {how}")
    return written


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
