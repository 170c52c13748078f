"""The recording of a trained drive: its scene, and the sensors that recorded it."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from drivesplat.drive.cameras import PoseableCamera
from drivesplat.drive.lidars import PoseableLidar
from drivesplat.editing.ego import MAX_LEAD
from drivesplat.editing.sensor_path import EgoPoses, recorded_ego
from drivesplat.errors import RequestError
from drivesplat.lidar.moved_sensor import sensor_poses_of
from drivesplat.lidar.scans import SensorPoses
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask, read_ego_mask
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scan import ScanRays
from drivesplat.scene.scan_record import RecordedScan, ScanRecords, read_scans
from drivesplat.scene.scene import REFINED, Frame, Scene, Track, read_scene
from drivesplat.scene.shutter import readout_of
from drivesplat.scene.tracks import box_at, ever_moves
from drivesplat.scene.training_record import TrainingRecord, read_training_record
from drivesplat.settings.tracks import FOUND, TRACK_FOLDERS, Tracks
from drivesplat.trajectories.camera_path import recorded_frames, recorded_timestamps, smooth_path
from drivesplat.trajectories.lateral_offset import PosesAt

if TYPE_CHECKING:
    import pandas

COLUMNS = [
    "id", "class", "category", "length", "width", "height", "first", "last", "speed", "editable", "why_not",
]  # fmt: skip
"""The columns of `object_table`."""


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A scene with the tracks of a method, its training images, the outlines of the vehicle's own body in them, and the
    file of its LiDAR scans, which may be missing. `where` names scene and method in messages. Times are seconds since
    the first image. `files` are the others that it was read from."""

    where: str
    scene: Scene
    record: TrainingRecord
    ego_mask: EgoMask
    scans_file: Path
    files: tuple[Path, ...] = ()

    @classmethod
    def of_method(cls, folder: Path, tracks: Sequence[str], refined: bool) -> "RecordedDrive":
        """The recording of the method with the result folder `folder`, whose model has these tracks, and poses that
        were `refined` or not. Raises ResultError for missing files and those of another version."""
        results = folder.parent
        own: Tracks = "discovered" if any(track.startswith(FOUND) for track in tracks) else "annotated"
        record = results / (REFINED if refined and own == "annotated" else Path(TRACK_FOLDERS[own], "scene.json"))
        scene = read_scene(record)
        # Images and rays are the same with any tracks.
        of_tracks = [results / TRACK_FOLDERS[of] for of in (own, "none")]
        parsers, scans = ([path / name for path in of_tracks] for name in ("parser.npz", "scans.npz"))
        parser, scan = (next((path for path in paths if path.is_file()), paths[0]) for paths in (parsers, scans))
        masks = [path for path in [results / "own_car.json"] if path.is_file()]
        ego_mask = read_ego_mask(masks[0])[0] if masks else NO_EGO_MASK
        where = f"scene {scene.name}, method {folder.name}"
        return cls(where, scene, read_training_record(parser), ego_mask, scan, (record, parser, *masks))

    @cached_property
    def cameras(self) -> list[str]:
        """The names of the recorded cameras."""
        return list(dict.fromkeys(frame.camera for frame in self.scene.frames))

    @cached_property
    def front_camera(self) -> str:
        """The camera that looks ahead the most, the first of equal ones. Raises RequestError without cameras."""
        camera = self.scene.front_camera(self.cameras)
        if camera is None:
            raise RequestError(f"{self.where} has no camera")
        return camera

    @cached_property
    def lidars(self) -> list[str]:
        """The names of the recorded LiDARs."""
        return list(dict.fromkeys(sweep.lidar for sweep in self.scene.sweeps))

    @cached_property
    def duration(self) -> float:
        """The time of the last image in seconds; of the last sweep without images."""
        recordings = self.scene.frames or self.scene.sweeps
        return self.scene.seconds(max(recording.timestamp for recording in recordings))

    def checked(self, time: float) -> float:
        """A time within the recording. Raises RequestError for any other."""
        if not 0.0 <= time <= self.duration:
            raise RequestError(self.outside(time))
        return time

    def outside(self, time: float) -> str:
        """A sentence about a time outside of the recording."""
        return f"{self.where} was recorded from 0 to {self.duration:.2f} s, not at {time:g} s"

    def camera(self, name: str, exposure: bool = False, rolling_shutter: bool = False) -> PoseableCamera:
        """A recorded camera: see `TrainedDrive.camera`."""
        index, frame = self.first_image(name)
        width, height = self.record.image_size(index)
        readout, known = np.zeros(3), {camera.name: camera for camera in self.scene.cameras}
        if rolling_shutter and name in known and readout_of(known[name]).any():
            readout = np.append(readout_of(known[name]), frame.readout_middle_s)
        return PoseableCamera(
            width, height, self.record.Ks[index].astype(np.float64), frame.camera_to_ego, name if exposure else None,
            name, readout, covered=tuple(self.ego_mask.outlines.get(name, ())),
        )  # fmt: skip

    def camera_of_name(self, name: str) -> PoseableCamera:
        """The same as `camera`, made once: not to be given to a caller that could change it."""
        if name not in self._named_cameras:
            self._named_cameras[name] = self.camera(name)
        return self._named_cameras[name]

    @cached_property
    def _named_cameras(self) -> dict[str, PoseableCamera]:
        return {}

    def first_image(self, name: str) -> tuple[int, Frame]:
        """The first image of a camera and its index. Raises RequestError for an unknown camera."""
        for index, frame in enumerate(self.scene.frames):
            if frame.camera == name:
                return index, frame
        raise RequestError(f"{self.where} has no camera {name!r}; there are: {', '.join(self.cameras) or 'none'}")

    def camera_to_world(self, name: str, time: float) -> Float64[np.ndarray, "4 4"]:
        """The pose of a camera on the smooth path through its images. Raises RequestError for a time at which it did
        not record."""
        self._require_recorded(name, time)
        return self._camera_paths[name](np.array([time]) * 1e6)[0]

    @cached_property
    def _camera_paths(self) -> dict[str, PosesAt]:
        """The path of each camera by time in microseconds since the first image of the scene."""
        paths = {}
        for name, seconds in self._image_seconds.items():
            poses = np.stack([frame.camera_to_world for frame in recorded_frames(self.scene, name)])
            paths[name] = smooth_path(seconds * 1e6, poses)
        return paths

    @cached_property
    def _image_seconds(self) -> dict[str, Float64[np.ndarray, " n"]]:
        """The seconds of the images of each camera."""
        found = {}
        for name in self.cameras:
            stamps = recorded_timestamps(self.scene, name)
            found[name] = self.scene.seconds(stamps[0]) + (stamps - stamps[0]) * 1e-6
        return found

    @cached_property
    def ego(self) -> EgoPoses:
        """The poses of the vehicle, by the images of the first camera; without cameras by sweeps."""
        return recorded_ego(self.scene, self.cameras[0] if self.cameras else None)

    def ego_to_world(self, time: float) -> Float64[np.ndarray, "4 4"]:
        """The pose of the vehicle. Raises RequestError for a time at which the first camera did not record."""
        if self.cameras:
            self._require_recorded(self.cameras[0], time)
        return self.ego(np.array([self.checked(time)]))[0]

    def _require_recorded(self, camera: str, time: float) -> None:
        """Raises RequestError for a time at which a camera did not record."""
        recorded = self._image_seconds[camera]
        if not recorded[0] - MAX_LEAD <= self.checked(time) <= recorded[-1] + MAX_LEAD:
            raise RequestError(
                f"camera {camera} recorded from {recorded[0]:.2f} to {recorded[-1]:.2f} s, not at {time:g} s"
            )

    @cached_property
    def scans(self) -> ScanRecords:
        """The recorded scans. Raises RequestError where none were prepared."""
        if not self.scans_file.is_file():
            raise RequestError(
                f"{self.where}: {self.scans_file} is missing, which has the rays of recorded LiDARs; give a LiDAR of "
                "your own (drivesplat.Lidar), or make it with snakemake"
            )
        return read_scans(self.scans_file)

    def nearest_scan(self, lidar: str, time: float) -> RecordedScan:
        """The scan of a LiDAR that is nearest in time. Raises RequestError for an unknown LiDAR."""
        if lidar not in self.lidars:
            raise RequestError(f"{self.where} has no LiDAR {lidar!r}; there are: {', '.join(self.lidars) or 'none'}")
        own = [scan for scan in self.scans.scans if scan.lidar == lidar]
        if not own:
            raise RequestError(f"{self.where}: {self.scans_file} has no scan of {lidar}: its rays are not known")
        return min(own, key=lambda scan: abs(scan.seconds - time))

    def lidar(self, name: str, time: float) -> PoseableLidar:
        """A recorded LiDAR with the rays of its scan that is nearest in time, and its mount."""
        scan = self.nearest_scan(name, time)
        ego = self.ego(np.array([scan.seconds]))[0]
        rays = scan.scan.rays
        copied = ScanRays(rays.azimuths.copy(), rays.elevations.copy(), rays.offsets_s.copy())
        return PoseableLidar(copied, inverse(ego) @ scan.sensor_to_world, scan.blocked.copy())

    def carried(self, scan: RecordedScan, ego: EgoPoses, time: float) -> SensorPoses:
        """The poses of the sensor of a recorded scan at a time, on a vehicle that drives as `ego` says."""
        sensor = sensor_poses_of(scan)

        def at(offsets: np.ndarray) -> np.ndarray:
            return ego(time + offsets) @ inverse(self.ego(scan.seconds + offsets)) @ sensor(offsets)

        return at


def object_table(scene: Scene, editable: Collection[str]) -> "pandas.DataFrame":
    """The objects of a scene as a table: see `TrainedDrive.actors`. `editable` are the ids of those that the model has
    Gaussians of."""
    from pandas import DataFrame  # here: it takes long to import

    rows = [_row(scene, track, editable) for track in scene.tracks if track.object_class.is_dynamic]
    table = DataFrame(rows, columns=COLUMNS).set_index("id")
    return table.sort_values(["editable", "first"], ascending=[False, True])


def _row(scene: Scene, track: Track, editable: Collection[str]) -> list[Any]:
    boxes = (box_at(track, int(timestamp), 0.0) for timestamp in track.timestamps)
    speed = max((box.speed for box in boxes if box is not None), default=0.0)
    first, last = (scene.seconds(track.timestamps[i]) for i in (0, -1))
    own = track.id in editable
    why_not = "" if own else "no Gaussians of its own in this method" if ever_moves(track) else "parked"
    size = [round(float(edge), 3) for edge in track.size]
    return [track.id, track.object_class.value, track.category, *size, first, last, round(speed, 2), own, why_not]
