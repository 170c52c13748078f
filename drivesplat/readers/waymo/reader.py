"""Reads a segment of the Waymo Open Dataset into a `Scene`.

Key frames are Waymo's frames, at 10 Hz: their timestamps are those of boxes and sweeps. Every image has its own time
and vehicle pose, 22 to 72 ms later. Boxes and sweeps belong to the pose of their frame.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import (
    MAX_COORDINATE,
    checked_box_size,
    checked_numbers,
    checked_text,
    checked_timestamp,
    is_number,
    require_increasing,
)
from drivesplat.readers.drive.reader import nominal_rate
from drivesplat.readers.drive_checks import require_microseconds
from drivesplat.readers.outline import frames_beyond
from drivesplat.readers.record_names import named, shown
from drivesplat.readers.waymo import v1, v2
from drivesplat.readers.waymo.calibration import camera_mount, camera_of, laser_mount, lidar_of, pose_of, readout_middle
from drivesplat.readers.waymo.layout import segment_files
from drivesplat.readers.waymo.names import CAMERAS, LASERS, V1, V2
from drivesplat.readers.waymo.segment import BoxRecord, ImageRecord, Segment, frame_name
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame, Scene, Sweep, Track
from drivesplat.scene.sensors import Camera
from drivesplat.settings.extract import SceneSource

READER = "waymo"
LICENCE = "Waymo Dataset License Agreement for Non-Commercial Use (https://waymo.com/open/terms)"
CLASSES = {
    1: ("vehicle", ObjectClass.VEHICLE),
    2: ("pedestrian", ObjectClass.PEDESTRIAN),
    3: ("sign", ObjectClass.OTHER_MOVABLE),
    4: ("cyclist", ObjectClass.RIDER),
}
"""Name and class by `Label.Type`. Waymo has one class for all vehicles, so that no pixel belongs to the region `car`.
Signs never move: OTHER_MOVABLE is what the protocol treats as static. Other types are of an unknown class, the same."""
UNKNOWN = ("unknown", ObjectClass.OTHER_MOVABLE)
FORMATS = {V1: v1, V2: v2}
"""The modules that read the files of each version."""
MAX_APART_US = 1_000_000
"""Maximum time in microseconds between a frame and its images."""


def read(root: Path, source: SceneSource, scene_tables: Path | None = None) -> Scene:
    """The scene of `source`, without the dataset's name. Paths of images and sweeps are relative to the folder into
    which `drivesplat.readers.waymo.unpack` writes them.

    All recordings are at key frames: `source.sweeps` and `source.lidar_sweeps` add none. `source.frames` = (first,
    last + 1) keeps these key frames, renumbered from 0. An image that is not there has the time and pose of its frame.
    Raises DatasetError naming the first fault.
    """
    files = segment_files(root, source.version, source.scene)
    return scene_of(FORMATS[files.version].read_segment(files), source)


def scene_of(segment: Segment, source: SceneSource) -> Scene:
    numbers = {name: number for number, name in CAMERAS.items()}
    unknown = [camera for camera in source.cameras if camera not in numbers]
    if unknown:
        raise DatasetError(f"scene {source.scene}: there is no camera {unknown[0]!r}; there are: {', '.join(numbers)}")
    every = sorted(checked_timestamp(time, frame_name(time)) for time in segment.frames)
    if not every:
        raise DatasetError(f"scene {source.scene}: segment {segment.name} has no frames; download it again")
    require_microseconds(every, f"scene {source.scene}")
    if fault := frames_beyond(source.scene, len(every), source.frames):
        raise DatasetError(fault)
    times = np.array(every[slice(*(source.frames or (None, None)))], dtype=np.int64)
    poses = [pose_of(segment.frames[int(time)], frame_name(int(time))) for time in times]
    reading = _SegmentReading(segment, times, poses, poses[0][:3, 3].copy())
    cameras = [numbers[camera] for camera in source.cameras]
    lasers = [number for number in LASERS if any(laser == number for _, laser in segment.sweeps)]
    return Scene(
        name=source.scene,
        dataset="",
        version=segment.version,
        description="",
        licence=LICENCE,
        origin=reading.origin,
        key_frame_timestamps=times,
        frames=tuple(frame for camera in cameras for frame in reading.frames(camera)),
        sweeps=tuple(sweep for laser in lasers for sweep in reading.sweeps(laser)),
        tracks=tuple(reading.tracks()),
        poses=READER,
        key_frame_hz=nominal_rate(times),
        key_frame_range=list(source.frames) if source.frames else None,
        cameras=tuple(reading.camera(camera) for camera in cameras),
        lidars=tuple(lidar_of(segment.laser(laser), segment.shapes.get(laser)) for laser in lasers),
    )


@dataclass(frozen=True)
class _SegmentReading:
    """A segment with its key frames, the vehicle's poses there, and the origin that is subtracted."""

    segment: Segment
    key_times: np.ndarray
    ego_poses: list[np.ndarray]
    origin: np.ndarray

    def camera(self, number: int) -> Camera:
        """A camera, with the readout time of its images."""
        images = (image for image in self.segment.images if image.camera == number)
        return camera_of(self.segment.camera(number), images)

    def frames(self, number: int) -> Iterator[Frame]:
        """The images of a camera."""
        name, mount = CAMERAS[number], camera_mount(self.segment.camera(number))
        camera = self.camera(number)
        images: dict[int, ImageRecord] = {}
        for image in self.segment.images:
            if image.camera == number:
                record = f"image {name} of {frame_name(image.frame)}"
                if image.frame not in self.segment.frames:
                    raise DatasetError(f"{record}: the segment has no such frame")
                if image.frame in images:
                    raise DatasetError(f"{record}: the segment has it twice")
                images[image.frame] = image
        times = [self._time(images.get(int(key)), int(key)) for key in self.key_times]
        require_increasing(times, [f"{name}/{time}" for time in times], "image")
        for index, (key, time) in enumerate(zip(self.key_times.tolist(), times, strict=True)):
            image, ego = images.get(key), self.ego_poses[index]
            if image is not None:
                ego = pose_of(image.pose, f"image {name} of {frame_name(key)}")
            ego_to_world = self._shifted(ego)
            yield Frame(
                camera=name,
                timestamp=time,
                image_path=f"images/{name}/{time}.jpg",
                width=camera.width,
                height=camera.height,
                intrinsics=camera.intrinsics,
                camera_to_world=ego_to_world @ mount,
                ego_to_world=ego_to_world,
                is_key_frame=True,
                sample_index=index,
                token=f"{name}/{key}",
                readout_middle_s=0.0 if image is None else readout_middle(image),
            )

    def _time(self, image: ImageRecord | None, key: int) -> int:
        """An image's time in microseconds; that of its frame where there is none."""
        if image is None:
            return key
        seconds, record = image.pose_timestamp, f"image {CAMERAS[image.camera]} of {frame_name(key)}"
        if not (is_number(seconds) and abs(seconds * 1e6 - key) <= MAX_APART_US):
            raise DatasetError(
                f"{record}: its time is {shown(seconds)} s, more than a second from that of its frame; both must be "
                "of one clock"
            )
        return round(seconds * 1e6)

    def sweeps(self, number: int) -> Iterator[Sweep]:
        name, mount = LASERS[number], laser_mount(self.segment.laser(number))
        of_laser = Counter(time for time, laser in self.segment.sweeps if laser == number)
        twice = next((time for time, count in of_laser.items() if count > 1), None)
        if twice is not None:
            raise DatasetError(f"{named('sweep', f'{name}/{twice}')}: the segment has it twice")
        for index, key in enumerate(self.key_times.tolist()):
            if key in of_laser:
                pose = self._shifted(self.ego_poses[index]) @ mount
                yield Sweep(f"sweeps/{name}/{key}.npz", key, pose, True, index, f"{name}/{key}", name, READER)

    def tracks(self) -> Iterator[Track]:
        """The objects with a box at any key frame, each with the median size of its boxes."""
        index_of = {key: index for index, key in enumerate(self.key_times.tolist())}
        boxes: dict[str, dict[int, BoxRecord]] = {}
        for box in self.segment.boxes:
            record = named("box", box.id)
            if box.frame not in self.segment.frames:
                raise DatasetError(f"{record}: the segment has no frame at its time {shown(box.frame)}")
            of_object = boxes.setdefault(checked_text(box.id, record, "id"), {})
            if box.frame in of_object:
                raise DatasetError(f"{record}: it has two boxes in {frame_name(box.frame)}")
            of_object[box.frame] = box
        for id_, of_object in boxes.items():
            found = [(index_of[time], of_object[time]) for time in sorted(of_object) if time in index_of]
            if not found:
                continue
            sizes, poses = [], []
            for index, box in found:
                record = f"{named('box', box.id)} in {frame_name(box.frame)}"
                sizes.append(checked_box_size(box.size, record))
                center = checked_numbers(box.center, 3, MAX_COORDINATE, record, "centre", "metres")
                heading = checked_numbers([box.heading], 1, 100.0, record, "heading", "radians")
                turn = Rotation.from_euler("z", heading[0]).as_matrix()
                poses.append(self._shifted(self.ego_poses[index]) @ rigid(turn, center))
            indices, (category, kind) = [index for index, _ in found], CLASSES.get(found[0][1].type, UNKNOWN)
            yield Track(
                id=id_,
                object_class=kind,
                category=category,
                size=np.median(sizes, axis=0),
                timestamps=self.key_times[indices],
                sample_indices=np.array(indices, dtype=np.int64),
                object_to_world=np.stack(poses),
                visibility=np.zeros(len(found), dtype=np.int64),
            )

    def _shifted(self, pose: np.ndarray) -> np.ndarray:
        shifted = pose.copy()
        shifted[:3, 3] -= self.origin
        return shifted
