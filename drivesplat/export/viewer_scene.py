"""The content of viewer.html: Gaussians by group, their motions and modes, the recorded camera, and the sky as arrays.

Coefficients of spherical harmonics beyond the first are `sh_range` t |t| with t the stored byte over 127, finest where
most of them are: near zero. So are modes, with `modes_range`.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from drivesplat.export.modes import Gait, Modes
from drivesplat.export.sampled_motion import SAMPLES_PER_SECOND, SampledMotion
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.export.viewer_boxes import BoxMotion
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.part import Sky
from drivesplat.rendering.color_bytes import to_uint8
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.trajectories.camera_path import recorded_frames, sampled_path
from drivesplat.trajectories.sampled_edit import InstanceMotion, SampledEdit


@dataclass(frozen=True)
class RecordedPath:
    """The recorded camera: its `first` frame, of whose size and intrinsics all are; its poses `camera_to_world`
    (n, 4, 4) at `seconds` (n,) since the first image; the seconds of its key frames; those of its `held_out` images by
    group; and the second of the last training image, its own if it has one (None: there is none)."""

    first: Frame
    seconds: np.ndarray
    camera_to_world: np.ndarray
    key_frames: tuple[float, ...]
    held_out: Mapping[str, Sequence[float]] = field(default_factory=dict)
    last_training: float | None = None


@dataclass(frozen=True)
class ViewerContent:
    """What a page shows: groups, a sky (None: black), the recorded camera, edited drives, the recorded `images`
    (records of `viewer_images`), the methods that have pages beside it, the `modes` of groups that deform, and the
    `boxes` of tracks that are no groups."""

    groups: Mapping[str, SampledGroup]
    sky: Sky | None
    antialiased: bool
    path: RecordedPath
    edits: Sequence[SampledEdit] = ()
    images: Sequence[dict[str, Any]] = ()
    method: str = ""
    methods: Sequence[str] = ()
    modes: Mapping[str, Modes] = field(default_factory=dict)
    boxes: Sequence[BoxMotion] = ()


def recorded_path(scene: Scene, record: TrainingRecord, camera: str) -> RecordedPath:
    """The path of a camera, with the split of its images by `record`. Raises DatasetError if the scene has no image of
    it."""
    frames = recorded_frames(scene, camera)
    times, poses = sampled_path(scene, camera, SAMPLES_PER_SECOND)
    own = [i for i in range(len(record.timestamps)) if record.camera_name(i) == camera]
    seconds = {
        group: [scene.seconds(record.timestamps[i]) for i in own if i in record.splits.get(group, ())]
        for group in ("train", *HELD_OUT_GROUPS)
    }
    trained = seconds.pop("train") or [scene.seconds(record.timestamps[i]) for i in record.train_images]
    return RecordedPath(
        frames[0],
        np.array([scene.seconds(time) for time in times]),
        poses,
        tuple(scene.seconds(frame.timestamp) for frame in frames if frame.is_key_frame),
        {group: sorted(found) for group, found in seconds.items()},
        max(trained, default=None),
    )


def splat_arrays(gaussians: Gaussians) -> tuple[dict[str, np.ndarray], float]:
    """The Gaussians in the page's encoding, and the largest coefficient of spherical harmonics beyond the first.

    `means` (n, 3) float32 and `scales` (n, 3) float16 in metres, unit `quats` (n, 4) float16, `opacities` (n,) uint8,
    `sh0` (n, 3) float16, `shN` (n, k - 1, 3) int8.
    """
    shN, sh_range = _roots(gaussians.shN.detach().cpu().numpy())
    largest = torch.finfo(torch.float16).max
    arrays = {
        "means": gaussians.means.float(),
        "scales": gaussians.scales.clamp(max=largest).half(),
        "quats": torch.nn.functional.normalize(gaussians.quats.float(), dim=-1).half(),
        "opacities": torch.round(gaussians.opacities * 255.0).to(torch.uint8),
        "sh0": gaussians.sh0[:, 0].clamp(-largest, largest).half(),
        "shN": torch.from_numpy(shN),
    }
    return {name: array.detach().contiguous().numpy() for name, array in arrays.items()}, sh_range


def _roots(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Values as bytes b, which stand for `largest` t |t| with t = b / 127, and that largest absolute value."""
    largest = float(np.abs(values).max()) if values.size else 0.0
    return np.round(127.0 * np.sign(values) * np.sqrt(np.abs(values) / (largest or 1.0))).astype(np.int8), largest


class SampleRows:
    """Samples of many motions one after the other: `seconds` (r,), `poses` (r, 3, 4) and, of those that deform by up to
    `modes` modes, `weights` (r, modes), elsewhere 0."""

    def __init__(self, modes: int = 0) -> None:
        self._seconds: list[np.ndarray] = [np.zeros(0)]
        self._poses: list[np.ndarray] = [np.zeros((0, 4, 4))]
        self._weights: list[np.ndarray] = [np.zeros((0, modes))]

    def add(self, seconds: np.ndarray, poses: np.ndarray, weights: np.ndarray | None = None) -> list[int]:
        """Appends poses (n, 4, 4) and weights (n, m) at `seconds` (n,); returns the range of their rows."""
        first = sum(map(len, self._seconds))
        padded = np.zeros((len(seconds), self._weights[0].shape[1]))
        if weights is not None:
            padded[:, : weights.shape[1]] = weights
        self._seconds.append(seconds)
        self._poses.append(poses)
        self._weights.append(padded)
        return [first, first + len(seconds)]

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        """The rows as float32 arrays `{name}_seconds`, `{name}_poses` and `{name}_weights`."""
        poses = np.concatenate(self._poses)[:, :3]
        columns = {"seconds": np.concatenate(self._seconds), "poses": poses, "weights": np.concatenate(self._weights)}
        return {f"{name}_{key}": values.astype(np.float32) for key, values in columns.items()}


@dataclass(frozen=True)
class MotionRecords:
    """Makes the records of groups and of edited drives, with their samples in `rows` and those of cameras in
    `camera_rows`; `modes` are those of groups that deform."""

    rows: SampleRows
    camera_rows: SampleRows
    modes: Mapping[str, Modes]

    def groups(self, groups: Mapping[str, SampledGroup]) -> list[dict[str, Any]]:
        """A record for each group: the number of its `gaussians`, its motion, what its track says, and `modes`, the
        first row of its modes (null: it is rigid)."""
        deforming = [len(groups[name].gaussians) if name in self.modes else 0 for name in groups]
        firsts = np.cumsum([0, *deforming])
        return [
            {
                "name": name,
                "category": group.track.category if group.track else None,
                "size": group.track.size.tolist() if group.track else None,
                "gaussians": len(group.gaussians),
                "modes": int(first) if name in self.modes else None,
                **self._motion(group.motion, name, None if group.motion is None else Gait(group.motion.seconds)),
            }
            for (name, group), first in zip(groups.items(), firsts[:-1], strict=True)
        ]

    def edits(self, drives: Sequence[SampledEdit], groups: Sequence[str]) -> list[dict[str, Any]]:
        """A record for each edited drive: its `instances`, each with the number of its `group` and what differs from
        it, and the range of rows of its `camera`; null: as recorded."""
        records = []
        for drive in drives:
            instances = []
            for instance in drive.instances:
                record: dict[str, Any] = {"id": instance.id, "group": groups.index(instance.source)}
                moved = instance.motion
                if moved is not None:
                    colors = None if instance.color_matrix is None else instance.color_matrix.ravel().tolist()
                    gait = Gait(moved.seconds, moved.walked, instance.scale, instance.phase)
                    record |= {
                        "category": instance.category, "size": instance.size.tolist(), "scale": instance.scale,
                        "colors": colors, **self._motion(moved, instance.source, gait),
                    }  # fmt: skip
                instances.append(record)
            camera = drive.camera and self.camera_rows.add(drive.camera.seconds, drive.camera.camera_to_world)
            records.append({"name": drive.name, "instances": instances, "camera": camera})
        return records

    def _motion(self, motion: SampledMotion | InstanceMotion | None, group: str, gait: Gait | None) -> dict[str, Any]:
        """The intervals `present` (seconds) and the range `samples` of rows of a motion; null for a static group."""
        if motion is None:
            return {"present": None, "samples": None}
        weights = self.modes[group].weights(gait) if group in self.modes and gait and len(gait.seconds) else None
        samples = self.rows.add(motion.seconds, motion.object_to_world, weights)
        return {"present": [list(span) for span in motion.spans], "samples": samples}


def box_records(boxes: Sequence[BoxMotion]) -> tuple[list[dict[str, Any]], SampleRows]:
    """A record for each box: what its track says, and its motion as in records of groups, with its own rows."""
    rows, records = SampleRows(), []
    for box in boxes:
        motion = {"present": [list(span) for span in box.spans], "samples": rows.add(box.seconds, box.object_to_world)}
        records.append({"id": box.track.id, "category": box.track.category, "size": box.track.size.tolist(), **motion})
    return records, rows


def modes_array(groups: Sequence[str], modes: Mapping[str, Modes], count: int) -> tuple[np.ndarray, float]:
    """The modes of all groups that deform, in order, as bytes (n, count, 2, 3): the shift (metres) and the turn of each
    Gaussian in every mode, 0 beyond those of its group; and the largest absolute value."""
    found = [np.zeros((0, count, 2, 3))]
    for own in (modes[name] for name in groups if name in modes):
        stacked = np.stack([own.shifts, own.turns], axis=2).transpose(1, 0, 2, 3)  # (n, m, 2, 3)
        found.append(np.pad(stacked, ((0, 0), (0, count - len(own.shifts)), (0, 0), (0, 0))))
    return _roots(np.concatenate(found))


def scene_record(content: ViewerContent, sky_size: int) -> tuple[dict[str, Any], bytes]:
    """What the page's scripts read, and the compressed arrays that it lists."""
    groups, path, first = content.groups, content.path, content.path.first
    gaussians = concatenate([group.gaussians for group in groups.values()])
    arrays, sh_range = splat_arrays(gaussians)
    count = max((len(modes.shifts) for modes in content.modes.values()), default=0)
    modes, modes_range = modes_array([*groups], content.modes, count)
    motions, cameras = SampleRows(count), SampleRows()
    made = MotionRecords(motions, cameras, content.modes)
    records, camera = made.groups(groups), cameras.add(path.seconds, path.camera_to_world)
    edits, (boxes, box_rows) = made.edits(content.edits, [*groups]), box_records(content.boxes)
    samples = motions.arrays("motion") | cameras.arrays("camera") | box_rows.arrays("box")
    others = {"modes": modes, "sky": sky_faces(content.sky, sky_size)}
    layout, payload = packed({**arrays, **samples, **others})
    record = {
        "count": len(gaussians),
        "coefficients": 1 + gaussians.shN.shape[1],
        "antialiased": content.antialiased,
        "sh_range": sh_range,
        "modes": count,
        "modes_range": modes_range,
        "sky_size": sky_size,
        "has_sky": content.sky is not None,
        "frame": {
            "width": first.width,
            "height": first.height,
            "K": continuous_intrinsics(first, (first.width, first.height)).tolist(),
        },
        "key_frames": list(path.key_frames),
        "held_out": {group: list(seconds) for group, seconds in path.held_out.items()},
        "last_training": path.last_training,
        "camera": camera,
        "groups": records,
        "boxes": boxes,
        "edits": edits,
        "images": list(content.images),
        "method": content.method,
        "methods": list(content.methods),
        "arrays": layout,
    }
    return record, payload


@torch.no_grad()
def sky_faces(sky: Sky | None, size: int) -> np.ndarray:
    """The sky (6, size, size, 3) uint8 as an OpenGL cube map in world directions: faces +x -x +y -y +z -z."""
    if sky is None:
        return np.zeros((6, size, size, 3), np.uint8)
    # the directions of its texels (t, s): OpenGL 4.5 specification, table of section 8.13
    line = (torch.arange(size) + 0.5) * (2.0 / size) - 1.0
    t, s = torch.meshgrid(line, line, indexing="ij")
    one = torch.ones_like(s)
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    rays = torch.nn.functional.normalize(torch.stack([torch.stack(face, dim=-1) for face in faces]), dim=-1)
    return torch.stack([to_uint8(sky.colors(face)) for face in rays]).numpy()


def packed(arrays: dict[str, np.ndarray]) -> tuple[list[dict[str, Any]], bytes]:
    """The offset (bytes) and length (values) of each array, and all arrays compressed with zlib."""
    layout, content = [], bytearray()
    for name, array in arrays.items():
        content.extend(bytes(-len(content) % 4))
        layout.append({"name": name, "dtype": array.dtype.name, "offset": len(content), "length": array.size})
        content.extend(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return layout, zlib.compress(bytes(content), level=9)
