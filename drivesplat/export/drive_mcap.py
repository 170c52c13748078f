"""A drive folder as an MCAP file of ROS 2 messages: images, LiDAR, transforms, odometry and boxes.

Rendered, edited and simulated drives are drive folders, as recorded ones are. Messages are made one by one in the order
of their stamps.
"""

import heapq
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.export import ros_messages as ros
from drivesplat.export.drive_clouds import TimedSweep, recorded_sweeps, rendered_sweeps
from drivesplat.export.mcap_file import LATCHED, mcap_file
from drivesplat.io.jpeg import encoded_jpeg
from drivesplat.io.storage import Provenance
from drivesplat.io.unique_names import unique_names
from drivesplat.readers.drive.faults import faults_of, is_unposed
from drivesplat.readers.drive.format import FILE, Drive, DriveFrame, read_drive
from drivesplat.readers.drive.poses import EgoPath, matrix_of
from drivesplat.readers.drive.reader import ego_of, max_track_gap, sampled_track, usual_interval
from drivesplat.scene.images import DECODING_ERRORS, read_image
from drivesplat.scene.rigid import apply, inverse
from drivesplat.trajectories.camera_path import smooth_path

ORIENTATION = 0x0112
"""The EXIF tag of how to turn an image, which ROS's decoders follow and drive folders do not."""
HALF_SPAN = 0.05
"""Half the time in seconds between the two poses that give a velocity."""
END_OF_TIME = 2**31 * 1_000_000
"""Microseconds after 1970 that the seconds of a ROS message cannot hold."""
RIGID_M = 1e-4
"""Metres and radians by which the mount of a camera may vary and still be static."""
MIN_KNOT_INTERVAL = 40_000
"""Least time in microseconds between the poses of the ego vehicle through which its smooth path leads: images of
several cameras follow each other within milliseconds, and differ by millimetres once their poses are refined."""
MIN_BOX_INTERVAL = 20_000
"""Least time in microseconds between messages of boxes."""
MIN_LIFETIME_S, INTERVALS = 0.15, 1.5
"""A box that nothing replaces vanishes after so many of the drive's usual intervals, at least these seconds."""

Timed = tuple[int, str, Any]
"""The stamp of a message in microseconds, its topic, and the message."""


def write_mcap(
    folder: Path, path: Path, scans: Path | None = None, provenance: Provenance | None = None
) -> dict[str, int]:
    """Writes the drive of a `folder` with drive.json as the MCAP file `path`. Returns the number of messages by topic.

    Args:
        folder: a drive folder (docs/own_data.md), recorded or rendered.
        scans: the scans.json of rendered LiDAR scans of the same rendered drive; None: the sweeps of the drive folder.
        provenance: where the file comes from; it is written into it.

    Raises DatasetError for a drive with faults, without poses, or whose files are missing or damaged, and for scans
    beside a drive that states no origin, as rendered ones do; ResultError for scans that cannot be read, and where
    `path` cannot be written; RequestError where rosbags is missing.

    >>> write_mcap(Path("results/demo/street/trajectories/original/drive"), Path("drive.mcap"))["/tf_static"]
    1
    """
    ros.ros_types()
    drive = read_drive(folder)
    if faults := faults_of(drive):
        raise DatasetError(f"{folder / FILE}: {faults[0]}")
    if is_unposed(drive):
        raise DatasetError(f"{folder / FILE}: there are no poses, without which ROS has no transforms; add ego_poses")
    timeline = EgoTimeline.of(drive)
    if timeline.stamps[-1] >= END_OF_TIME:
        raise DatasetError(f"{folder / FILE}: its times are later than 2038, which ROS cannot state; move them back")
    own = scans is None
    if not own and drive.origin is None:
        raise DatasetError(
            f"{folder / FILE}: it states no origin of its world, so that rendered scans may lie elsewhere; give the "
            "folder of a rendered drive"
        )
    sweeps = recorded_sweeps(drive, folder, timeline.path, timeline.origin) if own else rendered_sweeps(scans)
    source = {} if drive.rendered is None else drive.rendered.model_dump(mode="json", exclude={"provenance"})
    notes = {"description": drive.description, "licence": drive.licence, "rendered": json.dumps(source)}
    notes |= {} if provenance is None else {"provenance": json.dumps(provenance)}
    with mcap_file(path, notes) as file:
        for stamp, topic, message in DriveMessages(drive, folder, timeline, sweeps).in_order():
            file.write(topic, stamp, message)
    return file.counts


@dataclass(frozen=True, eq=False)
class EgoTimeline:
    """The ego vehicle at increasing `stamps` in microseconds: its `poses` in the map, whose origin is at `origin` in
    the world of the drive, metres."""

    stamps: Int64[np.ndarray, " n"]
    poses: Float64[np.ndarray, "n 4 4"]
    origin: Float64[np.ndarray, "3"]

    @classmethod
    def of(cls, drive: Drive) -> "EgoTimeline":
        """Of a drive with poses: `ego_poses` and the poses of images, or else those of sweeps. The map's origin is that
        of the drive's world where the drive states it, otherwise the first position."""
        ego = EgoPath(drive)
        known = {pose.timestamp: matrix_of(pose) for pose in drive.ego_poses}
        for frame in drive.frames:
            known.setdefault(frame.timestamp, ego_of(drive, frame, ego))
        for sweep in drive.sweeps if not known else ():
            assert sweep.lidar_to_world is not None
            mount = matrix_of(drive.lidars[sweep.lidar].sensor_to_ego)
            known[sweep.timestamp] = matrix_of(sweep.lidar_to_world) @ inverse(mount)
        stamps = sorted(known)
        poses = np.stack([known[stamp] for stamp in stamps])
        origin = poses[0, :3, 3].copy() if drive.origin is None else np.zeros(3)
        poses[:, :3, 3] -= origin
        return cls(np.array(stamps, dtype=np.int64), poses, origin)

    @cached_property
    def _smooth(self) -> Any:
        known = np.isin(self.stamps, _thinned(self.stamps, MIN_KNOT_INTERVAL))
        return smooth_path(self.stamps[known], self.poses[known])

    def path(self, stamps: np.ndarray) -> Float64[np.ndarray, "m 4 4"]:
        """The poses at any `stamps`, on a smooth path through the known ones; beyond their ends the motion goes on for
        a quarter of a second, and then stops."""
        reach = 250_000
        return self._smooth(np.clip(stamps, self.stamps[0] - reach, self.stamps[-1] + reach))

    def velocity(self, stamp: int) -> Float64[np.ndarray, "6"]:
        """The velocity along the vehicle's axes: linear (m/s), then angular (rad/s). 0 where a single pose is known."""
        ends = np.clip(stamp + np.array([-1e6, 1e6]) * HALF_SPAN, self.stamps[0], self.stamps[-1])
        if not ends[1] > ends[0]:
            return np.zeros(6)
        now, before, after = self.path(np.array([stamp, *ends]))
        turn = now[:3, :3].T @ before[:3, :3] @ Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
        return np.concatenate([now[:3, :3].T @ (after - before)[:3, 3], turn]) / (1e-6 * (ends[1] - ends[0]))


@dataclass(frozen=True, eq=False)
class DriveMessages:
    """The messages of a drive in `folder`."""

    drive: Drive
    folder: Path
    timeline: EgoTimeline
    sweeps: Sequence[TimedSweep]

    def in_order(self) -> Iterator[Timed]:
        """All messages in the order of their stamps, and at one stamp transforms first. Of every sensor one message is
        made ahead."""
        mounts = {self.names[lidar]: mount for lidar, mount in self._lidar_mounts.items()}
        mounts |= {_optical(self.names[camera]): mount for camera, mount in self._camera_mounts.items()}
        clouds = [self._clouds(lidar) for lidar in self._lidar_mounts]
        cameras = [self._images(camera) for camera in self.drive.cameras]
        rest = heapq.merge(self._ego(), *clouds, *cameras, self._boxes(), key=lambda timed: timed[0])
        for i, timed in enumerate(rest):
            if i == 0 and mounts:  # at the stamp of what begins first
                yield timed[0], LATCHED, ros.transforms(timed[0], ros.BASE, mounts)
            yield timed

    @cached_property
    def names(self) -> dict[str, str]:
        """The names of sensors as ROS allows them in topics and frames."""
        sensors = (*self.drive.cameras, *dict.fromkeys(sweep.lidar for sweep in self.sweeps))
        return unique_names(dict.fromkeys(sensors), _ros_name, (ros.MAP, ros.BASE, "objects", "tf", "odom"))

    @cached_property
    def _published(self) -> dict[int, np.ndarray]:
        """The poses of the ego vehicle on /tf by stamp: each has one, which tf2 insists on."""
        return dict(zip(self.timeline.stamps.tolist(), self.timeline.poses, strict=True))

    @cached_property
    def _lidar_mounts(self) -> dict[str, np.ndarray]:
        """The mounts of LiDARs: by the poses of sweeps that state one, otherwise by drive.json."""
        known = {name: matrix_of(lidar.sensor_to_ego) for name, lidar in self.drive.lidars.items()}
        found = {}
        for name in dict.fromkeys(sweep.lidar for sweep in self.sweeps):
            stated = [sweep for sweep in self.sweeps if sweep.lidar == name and sweep.pose is not None]
            first, last = self.timeline.stamps[[0, -1]]
            stated = [sweep for sweep in stated if first <= sweep.timestamp <= last] or stated
            if not stated:
                found[name] = known[name]
                continue
            ego = self.timeline.path(np.array([sweep.timestamp for sweep in stated]))
            found[name] = _middle(inverse(ego) @ np.stack([sweep.pose for sweep in stated]))
        return found

    @cached_property
    def _camera_mounts(self) -> dict[str, np.ndarray]:
        """The mounts of the cameras that keep theirs; refined poses may differ from image to image."""
        found = {}
        for name, camera in self.drive.cameras.items():
            own = [frame for frame in self.drive.frames if frame.camera == name and frame.camera_to_world is not None]
            mount = matrix_of(camera.sensor_to_ego)
            if own:
                mounts = np.stack([self._mount_of(frame) for frame in own])
                mount = _middle(mounts)
                if np.abs(mounts - mount).max() > RIGID_M:
                    continue
            if any(frame.camera == name for frame in self.drive.frames):
                found[name] = mount
        return found

    def _mount_of(self, frame: DriveFrame) -> np.ndarray:
        assert frame.camera_to_world is not None
        camera_to_map = matrix_of(frame.camera_to_world)
        camera_to_map[:3, 3] -= self.timeline.origin
        return inverse(self._published[frame.timestamp]) @ camera_to_map

    def _ego(self) -> Iterator[Timed]:
        """Transforms and odometry of the ego vehicle."""
        for stamp, pose in zip(self.timeline.stamps.tolist(), self.timeline.poses, strict=True):
            yield stamp, "/tf", ros.transforms(stamp, ros.MAP, {ros.BASE: pose})
            yield stamp, "/odom", ros.odometry(stamp, pose, self.timeline.velocity(stamp))

    def _images(self, camera: str) -> Iterator[Timed]:
        """Images and their calibration, and the mount of a camera that has no static one."""
        name, record, sensor = self.names[camera], self.drive.cameras[camera], self.drive.cameras[camera].sensor(camera)
        frames = sorted((f for f in self.drive.frames if f.camera == camera), key=lambda frame: frame.timestamp)
        for frame in frames:
            stamp, optical = frame.timestamp, _optical(name)
            if camera not in self._camera_mounts:
                mounted = {optical: self._mount_of(frame)} if frame.camera_to_world else {}
                mounted = mounted or {optical: matrix_of(record.sensor_to_ego)}
                yield stamp, "/tf", ros.transforms(stamp, ros.BASE, mounted)
            data = jpeg_bytes(self.folder / frame.file, (record.width, record.height))
            yield stamp, f"/{name}/image_raw/compressed", ros.jpeg_image(stamp, optical, data)
            yield stamp, f"/{name}/camera_info", ros.camera_info(stamp, optical, sensor)

    def _clouds(self, lidar: str) -> Iterator[Timed]:
        """Point clouds, each with the pose of the ego vehicle at its stamp."""
        name, mount = self.names[lidar], self._lidar_mounts[lidar]
        for cloud in (sweep.load() for sweep in self.sweeps if sweep.lidar == lidar):
            stamp = cloud.stamp
            if stamp not in self._published:
                self._published[stamp] = cloud.sensor_to_map @ inverse(mount)
                yield stamp, "/tf", ros.transforms(stamp, ros.MAP, {ros.BASE: self._published[stamp]})
            points = apply(inverse(self._published[stamp] @ mount), cloud.points).astype(np.float32)
            message = ros.point_cloud(stamp, name, points, cloud.intensity, cloud.ring, cloud.t)
            yield stamp, f"/{name}/points", message

    def _boxes(self) -> Iterator[Timed]:
        """The boxes at the times of their poses; an object without a pose at one of them is interpolated."""
        tracks = self.drive.tracks
        every = np.unique([pose.timestamp for track in tracks for pose in track.poses]).astype(np.int64)
        times = _thinned(every, MIN_BOX_INTERVAL)
        usual = usual_interval(tracks)
        at: dict[int, list[ros.PlacedBox]] = {time: [] for time in times.tolist()}
        for number, track in enumerate(tracks):
            own = sampled_track(track, times, self.timeline.origin, max_track_gap(track, usual))
            for time, pose in zip(own.timestamps.tolist(), own.object_to_world, strict=True) if own else ():
                at[time].append(ros.PlacedBox(number, own.id, own.object_class, own.size, pose))
        lifetime = max(MIN_LIFETIME_S, INTERVALS * usual * 1e-6)
        for stamp, boxes in at.items():
            yield stamp, "/objects/markers", ros.markers(stamp, boxes, lifetime)
            yield stamp, "/objects/detections", ros.detections(stamp, boxes)


def jpeg_bytes(path: Path, size: tuple[int, int]) -> bytes:
    """An image file as a JPEG of `size`: its own bytes where it is one that every decoder shows as drive folders mean
    it, otherwise encoded anew. Raises DatasetError where it is missing, damaged, or of another size."""
    try:
        with Image.open(path) as image:
            found, turned = image.size, image.getexif().get(ORIENTATION, 1) != 1
            ready = image.format == "JPEG" and image.mode in ("RGB", "L") and not turned
        if found == size and ready:
            return path.read_bytes()
    except DECODING_ERRORS as error:
        raise DatasetError(f"image {path} cannot be read ({error}); restore it, or take it out of drive.json") from None
    if found != size:
        raise DatasetError(f"image {path} is {found[0]}x{found[1]}, but its camera has {size[0]}x{size[1]}")
    return encoded_jpeg(read_image(path))


def _optical(name: str) -> str:
    """The frame of a camera with x right, y down, z forward."""
    return f"{name}_optical_frame"


def _ros_name(name: str) -> str:
    """Letters, digits and single underscores, a letter first."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    return plain if plain[:1].isalpha() else f"sensor_{plain}".rstrip("_")


def _middle(poses: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "4 4"]:
    """The pose that is nearest to the median of all entries."""
    return poses[int(np.abs(poses - np.median(poses, axis=0)).sum(axis=(1, 2)).argmin())]


def _thinned(times: Int64[np.ndarray, " n"], interval: int) -> Int64[np.ndarray, " m"]:
    """Increasing times without those less than `interval` after the last one that is kept."""
    kept: list[int] = []
    for time in times.tolist():
        if not kept or time - kept[-1] >= interval:
            kept.append(time)
    return np.array(kept, dtype=np.int64)
