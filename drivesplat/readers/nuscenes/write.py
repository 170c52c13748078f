"""Writes a scene as nuScenes tables, which nuscenes-devkit and the nuScenes reader load."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivesplat.readers.files import link_or_copy
from drivesplat.readers.nuscenes.object_classes import category_of
from drivesplat.readers.nuscenes.table_rows import TableRows, pose_columns
from drivesplat.readers.nuscenes.tokens import token
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Frame, Scene, Track
from drivesplat.scene.tracks import Box, box_at

MOVING_VEHICLE, MOVING_PERSON, WITH_RIDER = "vehicle.moving", "pedestrian.moving", "cycle.with_rider"
"""Attributes that are written. Why an object stands, and whether a cycle has a rider, is not known otherwise."""
CYCLES = (ObjectClass.BICYCLE, ObjectClass.MOTORCYCLE)
REPEATED = (
    "attribute_tokens", "instance_token", "next", "num_lidar_pts", "num_radar_pts", "prev", "visibility_token",
    "shown_by",
)  # fmt: skip
"""The columns of annotations that the boxes in images repeat."""
RIG_SPREAD = 100_000
"""Microseconds, at most half a key-frame interval, by which a key frame and its images may be apart."""
IMAGE_BOXES = "image_annotations"
"""The table of boxes in images, which nuscenes-devkit's export_2d_annotations_as_json makes of recorded drives."""


@dataclass(frozen=True)
class ImageBox:
    """A box in the image of a key frame: left, top, right, bottom in continuous pixels, and the share of its object,
    also of what lies outside the image, that is `visible` there."""

    frame: Frame
    track_id: str
    corners: tuple[float, float, float, float]
    visible: float


@dataclass(frozen=True)
class Labels:
    """What the tables of a rendered drive say beyond its scene: what shows each track (`shown_by`), the LiDAR points of
    each of its annotations, the boxes in images, and the time of the last training image in microseconds (None:
    unknown)."""

    shown_by: Mapping[str, str]
    lidar_points: Mapping[str, Sequence[int]]
    image_boxes: Sequence[ImageBox]
    trained_until: int | None


def write_nuscenes(scene: Scene, labels: Labels, root: Path, version: str, log: dict[str, str]) -> None:
    """Writes the tables of a rendered scene below `root`/`version`, and hard links to its images, or copies, as
    nuScenes names them. `log` are the columns of its log, which names the vehicle.

    Image and ego poses are those of the scene; the mount of each camera is that of its first image. Boxes are those at
    key frames. Two columns are not nuScenes' own: `shown_by` of annotations, and `beyond_training` of samples and
    images.
    """
    tables = _SceneTables(scene, labels, log)
    mounts: dict[str, np.ndarray] = {}
    for frame in scene.frames:
        if frame.camera not in mounts:
            mounts[frame.camera], sensor = frame.camera_to_ego, token("sensor", frame.camera)
            tables.add("sensor", sensor, channel=frame.camera, modality="camera")
            tables.add(
                "calibrated_sensor", token(scene.name, "calibrated", frame.camera), sensor_token=sensor,
                camera_intrinsic=frame.intrinsics.tolist(), **pose_columns(mounts[frame.camera]),
            )  # fmt: skip
        name = tables.add_image(frame, frame.camera_to_world @ inverse(mounts[frame.camera]))
        link_or_copy(Path(frame.image_path), root / name)
    for track in scene.tracks:
        tables.add_track(track)
    tables.add_image_boxes()
    tables.write(root, version)


class _SceneTables(TableRows):
    """The tables of one scene, with its key frames. Poses of the scene become global ones."""

    def __init__(self, scene: Scene, labels: Labels, log: dict[str, str]):
        super().__init__(token(scene.name, "log"), log, (MOVING_VEHICLE, MOVING_PERSON, WITH_RIDER))
        self._scene, self._labels, self._origin = scene, labels, rigid(np.eye(3), scene.origin)
        count = len(scene.key_frame_timestamps)
        self.add(
            "scene", token(scene.name), log_token=token(scene.name, "log"), nbr_samples=count,
            first_sample_token=self._sample(0), last_sample_token=self._sample(count - 1), name=f"scene-{scene.name}",
            description=scene.description,
        )  # fmt: skip
        for index, time in enumerate(scene.key_frame_timestamps.tolist()):
            self.add_linked(
                "sample", (), self._sample(index), timestamp=time, scene_token=token(scene.name),
                beyond_training=self._beyond_training(time),
            )  # fmt: skip

    def add_image(self, frame: Frame, ego_to_world: np.ndarray) -> str:
        """Adds an image with its ego pose (4, 4); returns the path of its file below the dataset's root."""
        scene, camera, time = self._scene.name, frame.camera, frame.timestamp
        name, suffix = token(scene, camera, time), Path(frame.image_path).suffix
        folder = "samples" if frame.is_key_frame else "sweeps"
        path = f"{folder}/{camera}/{scene}__{camera}__{time}{suffix}"
        self.add("ego_pose", name, timestamp=time, **pose_columns(self._origin @ ego_to_world))
        self.add_linked(
            "sample_data", (camera,), name, sample_token=self._sample(frame.sample_index), ego_pose_token=name,
            calibrated_sensor_token=token(scene, "calibrated", camera), timestamp=time, fileformat=suffix[1:],
            is_key_frame=frame.is_key_frame, width=frame.width, height=frame.height, filename=path,
            beyond_training=self._beyond_training(time),
        )  # fmt: skip
        return path

    def add_track(self, track: Track) -> None:
        """Adds the boxes of an object."""
        name, category = self._scene.name, category_of(track.object_class, track.category)
        for i, index in enumerate(track.sample_indices.tolist()):
            box = box_at(track, int(track.timestamps[i]), self._scene.key_frame_interval)
            self.add_annotation(
                (name, "annotation", track.id, index), token(name, "instance", track.id), category, track.size,
                sample_token=self._sample(index), visibility_token=str(int(track.visibility[i])),
                attribute_tokens=_attributes(box), num_lidar_pts=self._labels.lidar_points[track.id][i],
                shown_by=self._labels.shown_by[track.id], **pose_columns(self._origin @ track.object_to_world[i]),
            )  # fmt: skip

    def add_image_boxes(self) -> None:
        """Adds the boxes in images, with the columns of their annotations as nuscenes-devkit repeats them."""
        scene, annotations = self._scene, {row["token"]: row for row in self.rows["sample_annotation"]}
        categories = {row["token"]: row["name"] for row in self.rows["category"]}
        category_of_instance = {row["token"]: categories[row["category_token"]] for row in self.rows["instance"]}
        files = {row["token"]: row["filename"] for row in self.rows["sample_data"]}
        self.rows[IMAGE_BOXES] = []
        for box in self._labels.image_boxes:
            image = token(scene.name, box.frame.camera, box.frame.timestamp)
            name = token(scene.name, "annotation", box.track_id, box.frame.sample_index)
            if (row := annotations.get(name)) is None:
                continue  # the object is there at the time of the image, and not at that of the key frame
            self.rows[IMAGE_BOXES].append(
                {
                    **{column: row[column] for column in REPEATED},
                    "category_name": category_of_instance[row["instance_token"]], "sample_annotation_token": name,
                    "sample_data_token": image, "filename": files[image], "bbox_corners": list(box.corners),
                    "visible_share": round(box.visible, 3),
                }
            )  # fmt: skip

    def _beyond_training(self, time: int) -> bool:
        until, slack = self._labels.trained_until, min(RIG_SPREAD, self._scene.key_frame_interval / 2.0)
        return until is not None and time > until + slack

    def _sample(self, index: int) -> str:
        return token(self._scene.name, "sample", index)


def _attributes(box: Box | None) -> list[str]:
    """The token of the attribute of a box, where it has one."""
    if box is None:
        return []
    if box.object_class is ObjectClass.RIDER:
        return [token(WITH_RIDER)]
    if not box.moves or box.object_class in CYCLES:
        return []
    return [token(MOVING_PERSON if box.object_class.is_human else MOVING_VEHICLE)]
