"""The static world of a trained drive as a coarse mesh, from depth that its recorded cameras show."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from scipy.spatial import cKDTree

from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.export.depth_fusion import DepthImage, fused_mesh
from drivesplat.io.triangle_mesh import TriangleMesh
from drivesplat.model.height_field import HeightField
from drivesplat.scene.scene import Frame
from drivesplat.trajectories.camera_path import recorded_frames

EDGE = 0.3
"""Metres between voxels."""
MAX_DEPTH, MIN_ALPHA, MAX_CLEAR = 40.0, 0.7, 0.05
"""Metres up to which depth counts, the least opacity where it does, and the largest where there is nothing."""
MAX_SLOPE = 0.5
"""Depth that differs by more than this share from a pixel beside it is between two surfaces."""
WIDTH, MAX_IMAGES, MIN_STEP = 400, 160, 1.0
"""The largest width of depth images in pixels, their largest number, and the metres between those of one camera."""
ON_PATH = 10.0
"""Metres beside the path within which the mesh has the ground where no image shows it."""


def drive_mesh(drive: TrainedDrive, ground: HeightField) -> TriangleMesh:
    """The surfaces within MAX_DEPTH of the recorded cameras, without the objects that have Gaussians of their own, and
    the `ground` on which the vehicle drove."""
    path = drive.ego_path(np.linspace(0.0, drive.duration, 2 + int(drive.duration / 0.1)))[:, :2, 3]
    return fused_mesh(list(depth_images(drive)), EDGE, _near(ground, path))


def depth_images(drive: TrainedDrive) -> Iterator[DepthImage]:
    """The depth that the recorded cameras show, MIN_STEP apart, at most MAX_IMAGES in all."""
    per_camera = max(1, MAX_IMAGES // max(1, len(drive.cameras)))
    for name in drive.cameras:
        camera = drive.camera(name)
        camera = camera.resized(WIDTH) if camera.width > WIDTH else camera
        for frame in _thinned(recorded_frames(drive.scene, name), per_camera):
            world = drive.state(drive.scene.seconds(frame.timestamp), placements={})
            view = world.render(camera, camera_to_world=frame.camera_to_world, outputs=["depth", "alpha", "valid"])
            arrays = view.arrays()
            yield DepthImage(_known_depth(**arrays), camera.K, frame.camera_to_world)


def _known_depth(
    depth: Float32[np.ndarray, "h w"], alpha: Float32[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Depth as `DepthImage` has it, of what a drive renders."""
    opaque, clear = alpha >= MIN_ALPHA, alpha <= MAX_CLEAR
    known = np.where(opaque & (depth < MAX_DEPTH) & ~_between(depth), depth, 0.0)
    return np.where(valid, np.where(clear, np.inf, known), 0.0).astype(np.float32)


def _thinned(frames: list[Frame], most: int) -> list[Frame]:
    """The images that are MIN_STEP apart, evenly thinned to at most so many."""
    kept = frames[:1]
    for frame in frames[1:]:
        if np.linalg.norm(frame.camera_to_world[:3, 3] - kept[-1].camera_to_world[:3, 3]) >= MIN_STEP:
            kept.append(frame)
    chosen = np.unique(np.linspace(0, len(kept) - 1, min(most, len(kept))).astype(int))
    return [kept[i] for i in chosen]


def _between(depth: Float[np.ndarray, "h w"]) -> np.ndarray:
    """The pixels (h, w) at which depth steps, as at the edge of what stands before something else."""
    steps = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        near, far = (np.take(depth, np.arange(depth.shape[axis] - 1) + i, axis=axis) for i in (0, 1))
        step = np.abs(far - near) > MAX_SLOPE * np.minimum(near, far)
        pads = [[(0, 1) if a == axis else (0, 0) for a in (0, 1)], [(1, 0) if a == axis else (0, 0) for a in (0, 1)]]
        steps |= np.pad(step, pads[0]) | np.pad(step, pads[1])
    return steps


def _near(ground: HeightField, path: Float[np.ndarray, "p 2"]) -> HeightField:
    """The ground within ON_PATH of a path."""
    cells = np.stack(np.indices(tuple(ground.covered.shape)), axis=-1).reshape(-1, 2)
    middles = ground.lower.double().numpy() + ground.edge * (cells + 0.5)
    near = np.isfinite(cKDTree(path).query(middles, distance_upper_bound=ON_PATH)[0])
    return replace(ground, covered=ground.covered & torch.from_numpy(near).reshape(ground.covered.shape))
