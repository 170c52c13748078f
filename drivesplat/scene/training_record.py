"""The training record: the scene as training reads it, in parser.npz and parser.pkl."""

import pickle
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from drivesplat.io.array_file import read_typed_arrays, write_arrays
from drivesplat.io.storage import Provenance, atomic_write, no_provenance
from drivesplat.io.typed_record import field_values
from drivesplat.scene.shutter import Shutter

RULE = "parser"
MAX_SIDE = 65535
"""Pixels of the longest side of an image: the limit of JPEG."""


@dataclass(frozen=True)
class SceneInfo:
    """Properties of the scene that the measuring protocol reports; fields as in `drivesplat.scene.scene.Scene`."""

    name: str
    dataset: str
    version: str
    poses: str
    key_frame_range: list[int] | None = None
    missing_images: int = 0
    key_frame_hz: float | None = None


@dataclass(frozen=True)
class SeedInfo:
    """The number of seed points by source, in storage order; the number of missing LiDAR sweeps; and the name of the
    file of extra points (None: not given)."""

    lidar: int = 0
    triangulated: int = 0
    points_file: int = 0
    far: int = 0
    lidar_missing: int = 0
    extra_points: str | None = None


@dataclass(frozen=True)
class TrainingRecord:
    """A scene as training reads it: n images in the order of the scene's frames, and p seed points.

    Field names are the keys of parser.pkl, which users of gsplat's example trainer recognise. World frame: metres, z
    up. Cameras: OpenCV. `Ks` are in continuous pixels (the centre of the first pixel is at 0.5, 0.5) at `image_sizes`
    (width, height), the size at which images are trained and evaluated; `camtoworlds` is camera to world;
    `camera_indices` index `camera_names`; `timestamps` are in microseconds; `sample_indices` number the key frame that
    an image belongs to. `scene_scale` is the distance in metres of the farthest training camera from their mean, at
    least 1. `splits` has the image indices by group, `held_out_frames` the held-out key frames by group. `readout_s`
    and `camera_velocities` are those of `drivesplat.scene.shutter.Shutter`, 0 for an image with a global shutter; None
    where all have one.
    """

    Ks: Float[np.ndarray, "n 3 3"]
    camtoworlds: Float[np.ndarray, "n 4 4"]
    ego_to_world: Float[np.ndarray, "n 4 4"]
    image_paths: list[str]
    image_names: list[str]
    image_sizes: Int[np.ndarray, "n 2"]
    camera_names: list[str]
    camera_indices: Int[np.ndarray, " n"]
    timestamps: Int[np.ndarray, " n"]
    sample_indices: Int[np.ndarray, " n"]
    is_key_frame: Bool[np.ndarray, " n"]
    points: Float[np.ndarray, "p 3"]
    points_rgb: UInt8[np.ndarray, "p 3"]
    scene_scale: float
    splits: dict[str, np.ndarray]
    held_out_frames: dict[str, list[int]]
    scene: SceneInfo
    seed: SeedInfo
    readout_s: Float[np.ndarray, "n 3"] | None = None
    camera_velocities: Float[np.ndarray, "n 6"] | None = None
    provenance: Provenance = field(default_factory=no_provenance)

    @property
    def train_images(self) -> list[int]:
        return self.splits["train"].tolist()

    @property
    def train_cameras(self) -> set[str]:
        """The names of the cameras that have training images."""
        return {self.camera_name(i) for i in self.train_images}

    def image_size(self, index: int) -> tuple[int, int]:
        """Width and height in pixels at which an image is trained and evaluated."""
        width, height = self.image_sizes[index].tolist()
        return width, height

    def camera_name(self, index: int) -> str:
        """The name of the camera that recorded an image."""
        return self.camera_names[self.camera_indices[index]]

    def seconds(self, index: int) -> float:
        """The time of an image in seconds since the first one."""
        return float(self.timestamps[index] - self.timestamps.min()) * 1e-6

    def shutter(self, index: int) -> Shutter | None:
        """The rolling shutter of an image; None for a global shutter."""
        if self.readout_s is None or self.camera_velocities is None or not self.readout_s[index, :2].any():
            return None
        return Shutter(self.readout_s[index], self.camera_velocities[index])

    def fault(self) -> str | None:
        """What no record of `parser` holds, None without a fault."""
        count = len(self.Ks)
        if not len(self.image_paths) == len(self.image_names) == count:
            return f"it has {count} images, {len(self.image_paths)} paths"
        if "train" not in self.splits or (count and not len(self.splits["train"])):
            return "splits has no training images"
        for name, index, limit in (
            ("splits", np.concatenate(list(self.splits.values())), count),
            ("camera_indices", self.camera_indices, len(self.camera_names)),
        ):
            if index.dtype.kind not in "iu" or ((index < 0) | (index >= limit)).any():
                return f"{name} has indices out of range"
        if ((self.image_sizes < 1) | (self.image_sizes > MAX_SIDE)).any():
            return f"image_sizes has a side outside 1 to {MAX_SIDE} pixels"
        if (self.Ks[:, [0, 1], [0, 1]] <= 0.0).any():
            return "Ks has a focal length that is not positive"
        return None if self.scene_scale > 0.0 else "scene_scale is not positive"


def write_training_record(path: str | Path, record: TrainingRecord) -> None:
    """Writes parser.npz."""
    write_arrays(path, record)


def read_training_record(path: str | Path) -> TrainingRecord:
    """Reads parser.npz. Raises ResultError if it is invalid."""
    return read_typed_arrays(path, RULE, TrainingRecord, "a scene for training")


def write_training_pickle(path: str | Path, record: TrainingRecord) -> None:
    """Writes parser.pkl: a dictionary of plain containers and arrays under the keys of gsplat's example trainer."""
    nested = {"scene": field_values(record.scene), "seed": field_values(record.seed)}
    with atomic_write(path) as file:
        pickle.dump(field_values(record) | nested, file, protocol=4)
