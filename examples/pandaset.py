"""Converts a sequence of PandaSet (https://pandaset.org, layout of https://github.com/scaleapi/pandaset-devkit) to a
drive folder. SEQUENCE is the folder of a sequence, such as 001, with camera/, lidar/ and annotations/cuboids/.

Files of PandaSet are pickles, which are programs: they are read without executing them (pandas_pickle.py). The poses of
lidar/poses.json do not fit the times beside them. The vehicle's pose is therefore that of the front camera, at whose
times the LiDAR faces forward. The ego frame is below the LiDAR on the ground. Returns are those of the spinning LiDAR
(Pandar64); they are given in the world, each at its own time, and hold no rings. Images are taken as undistorted.

Moving objects in the view of both LiDARs have two boxes, of which the one by the spinning LiDAR is used. It belongs to
the time at which the LiDAR faced the object, and is interpolated to the frame's time.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1]))  # a checkout that is not installed

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import checked_intrinsics, checked_pose, is_number
from drivesplat.readers.drive.conversion import pose_at, reading, reported, timed_poses, warn, write_folder
from drivesplat.readers.drive.write import pose_record
from drivesplat.scene.rigid import apply, inverse, rigid
from examples.pandas_pickle import read_table

LICENCE = "PandaSet: CC BY 4.0 and its terms of use (https://pandaset.org), Xiao et al., PandaSet"
FRONT, LIDAR = "front_camera", "main_pandar64"
LIDAR_TO_FRONT = checked_pose(
    [0.0002585796504896516, -0.03907777167811011, -0.0440125762408362],
    [0.016213200031258722, 0.0030578899383849464, 0.7114721800418571, -0.7025205466606356],
    FRONT,
)
"""PandaSet's static_extrinsic_calibration.yaml."""
LIDAR_TO_EGO = rigid(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([0.0, 0.0, 2.1]))
"""The LiDAR's x axis points to the right, y forward. It is 2.1 m above the road in frame 0 of sequence 001."""
REVOLUTION_US, SPINNING, FORWARD = 100_000, 0, 1
"""Time of a revolution in microseconds, and the numbers of the spinning and of the forward LiDAR."""
CLASSES = {
    "car": ["Car"],
    "truck": ["Pickup Truck", "Medium-sized Truck", "Semi-truck"],
    "trailer": ["Towed Object"],
    "motorcycle": ["Motorcycle", "Motorized Scooter"],
    "construction_vehicle": ["Other Vehicle - Construction Vehicle"],
    "vehicle": ["Other Vehicle - Uncommon", "Other Vehicle - Pedicab", "Emergency Vehicle", "Personal Mobility Device"],
    "bicycle": ["Bicycle"],
    "bus": ["Bus"],
    "tram": ["Train", "Trolley", "Tram / Subway"],
    "pedestrian": ["Pedestrian", "Pedestrian with Object"],
    "animal": ["Animals - Bird", "Animals - Other"],
}
"""Labels by class; all others, such as cones, signs and barriers, are other_movable."""
CLASS_OF = {label: name for name, labels in CLASSES.items() for label in labels}


def records(path: Path) -> list[Any]:
    """The list in a JSON file."""
    with reading(path):
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, list):
            raise ValueError("it is no list")
        return found


def times_of(folder: Path) -> np.ndarray:
    """The times (n,) of a sensor in microseconds."""
    path = folder / "timestamps.json"
    times = records(path)
    wrong = next((i for i, time in enumerate(times) if not is_number(time) or not 0 < time < 1e10), None)
    if wrong is not None:
        raise DatasetError(f"{path}: time {wrong} is {str(times[wrong])[:40]}; it must be seconds since 1970")
    return np.array([round(time * 1e6) for time in times], dtype=np.int64)


def poses_of(folder: Path, count: int) -> np.ndarray:
    """The poses (count, 4, 4) of a sensor in the world."""
    path, found = folder / "poses.json", []
    for number, pose in enumerate(records(path)):
        with reading(path):
            position, heading = (
                [pose[key][axis] for axis in axes] for key, axes in (("position", "xyz"), ("heading", "wxyz"))
            )
        found.append(checked_pose(position, heading, f"{path}: pose {number}"))
    if len(found) != count:
        raise DatasetError(f"{path} has {len(found)} poses, and timestamps.json beside it {count} times")
    return np.stack(found) if found else np.empty((0, 4, 4))


def frames_of(folder: Path, suffixes: tuple[str, ...], count: int) -> dict[int, Path]:
    """The files of a folder by the number of their frame, below `count`."""
    files = sorted(path for path in folder.glob("*") if path.name.endswith(suffixes))
    found = {int(number): path for path in files if (number := path.name.partition(".")[0]).isdecimal()}
    beyond = next((path for number, path in found.items() if number >= count), None)
    if beyond or len(found) < len(files):
        raise DatasetError(f"{folder} has {len(files)} files (last: {files[-1].name}), and there are {count} times")
    return found


def camera_of(folder: Path, image: Path) -> dict[str, Any]:
    """The calibration of a camera, without its mount; `image` is one of its images."""
    path = folder / "intrinsics.json"
    with reading(path):
        values = json.loads(path.read_text(encoding="utf-8"))
        fx, fy, cx, cy = (values[name] for name in ("fx", "fy", "cx", "cy"))
    with reading(image), Image.open(image) as opened:
        width, height = opened.size
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return {"width": width, "height": height, "K": checked_intrinsics(matrix, str(path), (width, height)).tolist()}


def sweep_columns(path: Path, lidar_to_world: np.ndarray, time: int) -> dict[str, np.ndarray]:
    """The returns of the spinning LiDAR in a file, seen from its pose (4, 4) at `time`."""
    table = read_table(path)
    with reading(path):
        x, y, z, intensity, seconds, sensor = (
            table[name].astype(np.float64) for name in ("x", "y", "z", "i", "t", "d")
        )
        own = (sensor == SPINNING) & np.isfinite([x, y, z, intensity, seconds]).all(axis=0)
        offsets = seconds[own] - time * 1e-6
        points = apply(inverse(lidar_to_world), np.stack([x, y, z], axis=1)[own])
    if not own.any() or np.abs(offsets).max() > 2e-6 * REVOLUTION_US:
        raise DatasetError(
            f"{path} has no returns of the spinning LiDAR (d = {SPINNING}), or of another time than its frame"
        )
    columns = dict(zip("xyz", points.T.astype(np.float32), strict=True))
    return columns | {"intensity": (intensity[own] / 255.0).astype(np.float32), "time": offsets}


class Box(NamedTuple):
    """A box in the world: `pose` (4, 4) at the time `seen_at` in microseconds, annotated for the frame at `time`."""

    time: int
    seen_at: int
    pose: np.ndarray
    size: np.ndarray
    label: str


def track_of(name: str, boxes: list[Box]) -> dict[str, Any]:
    """An object with its poses at the times of frames, between those at which it was seen."""
    seen_at, poses = np.array([box.seen_at for box in boxes]), np.stack([box.pose for box in boxes])
    if (np.diff(seen_at) > 0).all():
        poses = np.stack([pose_at(seen_at, poses, box.time) for box in boxes])
    label, size = boxes[0].label, np.median([box.size for box in boxes], axis=0).tolist()
    shape = {"id": name, "class": CLASS_OF.get(label, "other_movable"), "category": label, "size": size}
    return shape | {"poses": timed_poses(np.array([box.time for box in boxes]), poses)}


def tracks(files: dict[int, Path], lidar_to_world: np.ndarray, times: np.ndarray) -> list[dict[str, Any]]:
    """The annotated objects at the `times` (n,) of frames. A box's yaw is 0 where its length points along y."""
    names = ("position.x", "position.y", "position.z", "yaw", "dimensions.y", "dimensions.x", "dimensions.z")
    boxes: dict[str, list[Box]] = {}
    for frame, path in files.items():
        table = read_table(path)
        with reading(path):
            values = np.stack([table[name].astype(np.float64) for name in names], axis=1)
            if not np.isfinite(values).all():
                raise ValueError("a box has a value that is not finite")
            ids, labels, still = table["uuid"].tolist(), table["label"].tolist(), table["stationary"].astype(bool)
            sensors, siblings = table["cuboids.sensor_id"], table["cuboids.sibling_id"]
        seen = apply(inverse(lidar_to_world[frame]), values[:, :3])
        offsets = np.where(still, 0.0, np.arctan2(seen[:, 0], seen[:, 1]) / (2 * np.pi) * REVOLUTION_US)
        for i in np.flatnonzero(
            [sensor != FORWARD or it not in ids for sensor, it in zip(sensors, siblings, strict=True)]
        ):
            pose = rigid(Rotation.from_euler("z", values[i, 3] + np.pi / 2).as_matrix(), values[i, :3])
            box = Box(times[frame], int(times[frame] + offsets[i]), pose, values[i, 4:], str(labels[i]))
            boxes.setdefault(str(ids[i]), []).append(box)
    return [track_of(name, found) for name, found in boxes.items()]


def convert(sequence: Path, out: Path, cameras: list[str] | None) -> Path:
    """Writes the drive folder; returns the path of its drive.json."""
    folders = {path.name: path for path in sorted((sequence / "camera").glob("*")) if path.is_dir()}
    lacking = [name for name in (FRONT, *(cameras or ())) if name not in folders]
    if lacking:
        raise DatasetError(
            f"{sequence / 'camera'} has no folder {lacking[0]}; there are: {', '.join(folders) or 'none'}"
        )
    times = times_of(folders[FRONT])
    lidar_to_world = poses_of(folders[FRONT], len(times)) @ LIDAR_TO_FRONT
    ego_to_world = lidar_to_world @ inverse(LIDAR_TO_EGO)

    mounted, frames, images = {}, [], {}
    for name in sorted(cameras or folders, key=lambda name: name != FRONT):
        own_times = times_of(folders[name])
        poses, files = (
            poses_of(folders[name], len(own_times)),
            frames_of(folders[name], (".jpg", ".png"), len(own_times)),
        )
        if not files:
            warn(f"{folders[name]} holds no images; the camera is left out")
            continue
        first = min(files)
        mount = inverse(pose_at(times, ego_to_world, own_times[first])) @ poses[first]
        mounted[name] = camera_of(folders[name], files[first]) | {"sensor_to_ego": pose_record(mount)}
        for i, path in files.items():
            file, pose = f"{name}/{path.name}", pose_record(poses[i])
            frames.append({"camera": name, "timestamp": int(own_times[i]), "file": file, "camera_to_world": pose})
            images[file] = path
    scans = frames_of(sequence / "lidar", (".pkl", ".pkl.gz"), len(times))
    boxes = frames_of(sequence / "annotations/cuboids", (".pkl", ".pkl.gz"), len(times))
    record = {
        "format": "drivesplat drive",
        "version": 1,
        "description": f"PandaSet {sequence.resolve().name}",
        "licence": LICENCE,
        "cameras": mounted,
        "lidars": {LIDAR: {"sensor_to_ego": pose_record(LIDAR_TO_EGO), "revolution_s": 1e-6 * REVOLUTION_US}},
        "ego_poses": timed_poses(times, ego_to_world),
        "key_frames": times.tolist(),
        "frames": frames,
        "sweeps": [{"lidar": LIDAR, "timestamp": int(times[i]), "file": f"{LIDAR}/{i:02}.npz"} for i in scans],
        "tracks": tracks(boxes, lidar_to_world, times),
    }
    sweeps = (
        (f"{LIDAR}/{i:02}.npz", sweep_columns(path, lidar_to_world[i], int(times[i]))) for i, path in scans.items()
    )
    return write_folder(out, record, images, sweeps)


def main(arguments: list[str] | None = None) -> int:
    """Converts a sequence; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path, help="folder of a sequence")
    parser.add_argument("out", type=Path, help="the drive folder, new or empty")
    parser.add_argument("--cameras", nargs="+", help="names of cameras; by default those that there are")
    asked = parser.parse_args(arguments)
    return reported("pandaset", lambda: convert(asked.sequence, asked.out, asked.cameras))


if __name__ == "__main__":
    sys.exit(main())
