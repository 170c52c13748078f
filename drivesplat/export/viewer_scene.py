"""The content of viewer.html: Gaussians by rigid group, their motions, the recorded camera, and the sky as arrays.

Coefficients of spherical harmonics beyond the first are `sh_range` t |t| with t the stored byte over 127, finest where
most of them are: near zero.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.edited_motion.edited_drive import EditedDrive, Instance, InstanceMotion
from drivesplat.export.sampled_motion import SAMPLES_PER_SECOND, SampledMotion
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.part import Sky
from drivesplat.rendering.color_bytes import to_uint8
from drivesplat.rendering.trajectory import recorded_frames, sampled_path
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.scene import Frame, Scene


@dataclass(frozen=True)
class RecordedPath:
    """The recorded camera: its poses `camera_to_world` (n, 4, 4) at `seconds` (n,) since the first image, the seconds
    of its key frames, and the frame `start` of the first view with its second."""

    start: Frame
    start_second: float
    seconds: np.ndarray
    camera_to_world: np.ndarray
    key_frames: tuple[float, ...]


@dataclass(frozen=True)
class ViewerContent:
    """What a page shows: rigid groups, a sky (None: black), the recorded camera, edited drives, the recorded `images`
    (records of `viewer_images`), and the methods of which it has pages beside it."""

    groups: Mapping[str, SampledGroup]
    sky: Sky | None
    antialiased: bool
    path: RecordedPath
    edits: Sequence[EditedDrive] = ()
    images: Sequence[dict[str, Any]] = ()
    method: str = ""
    methods: Sequence[str] = ()


def recorded_path(scene: Scene, camera: str) -> RecordedPath:
    """The path of a camera, starting at its middle key frame. Raises DatasetError if the scene has no key frame of
    it."""
    start, frames = scene.frames[scene.middle_key_frame(camera)], recorded_frames(scene, camera)
    times, poses = sampled_path(scene, camera, SAMPLES_PER_SECOND)
    return RecordedPath(
        start,
        scene.seconds(start.timestamp),
        np.array([scene.seconds(time) for time in times]),
        poses,
        tuple(scene.seconds(frame.timestamp) for frame in frames if frame.is_key_frame),
    )


def splat_arrays(gaussians: Gaussians) -> tuple[dict[str, np.ndarray], float]:
    """The Gaussians in the page's encoding, and the largest coefficient of spherical harmonics beyond the first.

    `means` (n, 3) float32 and `scales` (n, 3) float16 in metres, unit `quats` (n, 4) float16, `opacities` (n,) uint8,
    `sh0` (n, 3) float16, `shN` (n, k - 1, 3) int8.
    """
    shN = gaussians.shN.float()
    sh_range = float(shN.detach().abs().max()) if shN.numel() else 0.0
    roots = torch.sign(shN) * torch.sqrt(shN.abs() / (sh_range or 1.0))
    largest = torch.finfo(torch.float16).max
    arrays = {
        "means": gaussians.means.float(),
        "scales": gaussians.scales.clamp(max=largest).half(),
        "quats": torch.nn.functional.normalize(gaussians.quats.float(), dim=-1).half(),
        "opacities": torch.round(gaussians.opacities * 255.0).to(torch.uint8),
        "sh0": gaussians.sh0[:, 0].clamp(-largest, largest).half(),
        "shN": torch.round(roots * 127.0).to(torch.int8),
    }
    return {name: array.detach().contiguous().numpy() for name, array in arrays.items()}, sh_range


class PoseRows:
    """Poses of many motions one after the other: `seconds` (m,) and `poses` (m, 3, 4)."""

    def __init__(self) -> None:
        self._seconds: list[np.ndarray] = [np.zeros(0)]
        self._poses: list[np.ndarray] = [np.zeros((0, 4, 4))]

    def add(self, seconds: np.ndarray, poses: np.ndarray) -> list[int]:
        """Appends poses (n, 4, 4) at `seconds` (n,); returns the range of their rows."""
        first = sum(map(len, self._seconds))
        self._seconds.append(seconds)
        self._poses.append(poses)
        return [first, first + len(seconds)]

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        """The rows as float32 arrays `{name}_seconds` and `{name}_poses`."""
        seconds, poses = np.concatenate(self._seconds), np.concatenate(self._poses)[:, :3]
        return {f"{name}_seconds": seconds.astype(np.float32), f"{name}_poses": poses.astype(np.float32)}


def motion_record(motion: SampledMotion | InstanceMotion | None, rows: PoseRows) -> dict[str, Any]:
    """The intervals `present` (seconds) and the range `samples` of rows of a motion; null for a static group."""
    if motion is None:
        return {"present": None, "samples": None}
    samples = rows.add(motion.seconds, motion.object_to_world)
    return {"present": [list(span) for span in motion.spans], "samples": samples}


def group_records(groups: Mapping[str, SampledGroup], rows: PoseRows) -> list[dict[str, Any]]:
    """A record for each group: the number of its `gaussians`, its motion, and what its track says."""
    return [
        {
            "name": name,
            "category": group.track.category if group.track else None,
            "size": group.track.size.tolist() if group.track else None,
            "gaussians": len(group.gaussians),
            **motion_record(group.motion, rows),
        }
        for name, group in groups.items()
    ]


def edit_records(
    drives: Sequence[EditedDrive], groups: Sequence[str], rows: PoseRows, camera_rows: PoseRows
) -> list[dict[str, Any]]:
    """A record for each edited drive: its `instances`, each with the number of its `group` and what differs from it,
    and the range of rows of its `camera`; null: as recorded."""
    return [
        {
            "name": drive.name,
            "instances": [_instance_record(instance, groups, rows) for instance in drive.instances],
            "camera": drive.camera and camera_rows.add(drive.camera.seconds, drive.camera.camera_to_world),
        }
        for drive in drives
    ]


def _instance_record(instance: Instance, groups: Sequence[str], rows: PoseRows) -> dict[str, Any]:
    record: dict[str, Any] = {"id": instance.id, "group": groups.index(instance.source)}
    if instance.motion is None:
        return record
    colors = None if instance.color_matrix is None else instance.color_matrix.ravel().tolist()
    changed = {"category": instance.category, "size": instance.size.tolist(), "scale": instance.scale, "colors": colors}
    return {**record, **changed, **motion_record(instance.motion, rows)}


def scene_record(content: ViewerContent, sky_size: int) -> tuple[dict[str, Any], bytes]:
    """What the page's scripts read, and the compressed arrays that it lists."""
    groups, path = content.groups, content.path
    gaussians = concatenate([group.gaussians for group in groups.values()])
    arrays, sh_range = splat_arrays(gaussians)
    motions, cameras = PoseRows(), PoseRows()
    records = group_records(groups, motions)
    camera = cameras.add(path.seconds, path.camera_to_world)
    edits = edit_records(content.edits, [*groups], motions, cameras)
    sky = {"sky": sky_faces(content.sky, sky_size)}
    layout, payload = packed({**arrays, **motions.arrays("motion"), **cameras.arrays("camera"), **sky})
    record = {
        "count": len(gaussians),
        "coefficients": 1 + gaussians.shN.shape[1],
        "antialiased": content.antialiased,
        "sh_range": sh_range,
        "sky_size": sky_size,
        "has_sky": content.sky is not None,
        "start": {**start_pose(path.start), "second": path.start_second},
        "key_frames": list(path.key_frames),
        "camera": camera,
        "groups": records,
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
    return torch.stack([to_uint8(sky.colors(rays)) for rays in cube_rays(size)]).numpy()


def cube_rays(size: int) -> Float[Tensor, "6 size size 3"]:
    """Unit directions of a cube map's texels (face, t, s): OpenGL 4.5 specification, table of section 8.13."""
    line = (torch.arange(size) + 0.5) * (2.0 / size) - 1.0
    t, s = torch.meshgrid(line, line, indexing="ij")
    one = torch.ones_like(s)
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    return torch.nn.functional.normalize(torch.stack([torch.stack(face, dim=-1) for face in faces]), dim=-1)


def start_pose(frame: Frame) -> dict[str, Any]:
    """The camera of a recorded frame: `K` in continuous pixels of width x height, OpenCV `camera_to_world` (4, 4)."""
    return {
        "width": frame.width,
        "height": frame.height,
        "K": continuous_intrinsics(frame, (frame.width, frame.height)).tolist(),
        "camera_to_world": frame.camera_to_world.tolist(),
    }


def packed(arrays: dict[str, np.ndarray]) -> tuple[list[dict[str, Any]], bytes]:
    """The offset (bytes) and length (values) of each array, and all arrays compressed with zlib."""
    layout, content = [], bytearray()
    for name, array in arrays.items():
        content.extend(bytes(-len(content) % 4))
        layout.append({"name": name, "dtype": array.dtype.name, "offset": len(content), "length": array.size})
        content.extend(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return layout, zlib.compress(bytes(content), level=9)
