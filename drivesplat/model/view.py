"""A camera at a time, and its rolling shutter."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.model.gaussians import Gaussians
from drivesplat.scene.shutter import NEAR, Shutter, displaced
from drivesplat.scene.training_record import TrainingRecord


@dataclass(frozen=True)
class RollingShutter:
    """A rolling shutter. `readout_s` is that of `drivesplat.scene.shutter.Shutter`; `motion` maps a resting point (x,
    y, z, 1) in the camera's axes to its velocity (m/s) there."""

    readout_s: Float[Tensor, "3"]
    motion: Float[Tensor, "3 4"]

    @property
    def angular_velocity(self) -> Float[Tensor, "3"]:
        """That of the camera, radians per second along its own axes."""
        return torch.stack([-self.motion[2, 1], self.motion[2, 0], -self.motion[1, 0]])


def turned_motion(motion: Float[Tensor, "3 4"], turn: np.ndarray) -> Float[Tensor, "3 4"]:
    """The `RollingShutter.motion` of a camera at the same place whose axes `turn` (3, 3) rotates to this one's."""
    rotation = torch.from_numpy(turn).to(motion)
    return torch.cat([rotation.T @ motion[:, :3] @ rotation, rotation.T @ motion[:, 3:]], dim=1)


def inverse(pose: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """The inverse of a rigid transform."""
    rotation_t = pose[:3, :3].T
    upper = torch.cat([rotation_t, -rotation_t @ pose[:3, 3:]], dim=1)
    return torch.cat([upper, torch.eye(4, device=upper.device, dtype=upper.dtype)[3:]])


@dataclass(frozen=True)
class View:
    """A camera at a time: `K` in continuous pixels, `time` in seconds since the first image. `camera` names the camera
    of the rig whose exposure applies (None: `Exposures` says which). `shutter` is None for a global shutter; otherwise
    pose and time are those of the image's timestamp. `seconds` is `time` on the device, for captured steps."""

    K: Float[Tensor, "3 3"]
    camera_to_world: Float[Tensor, "4 4"]
    width: int
    height: int
    time: float
    camera: str | None = None
    shutter: RollingShutter | None = None
    seconds: Float[Tensor, ""] | None = None

    @property
    def moment(self) -> Float[Tensor, ""]:
        """`time` as a tensor."""
        return self.K.new_tensor(self.time) if self.seconds is None else self.seconds

    @cached_property
    def viewmat(self) -> Float[Tensor, "4 4"]:
        """World to camera."""
        return inverse(self.camera_to_world)

    @property
    def turning_by_line(self) -> Float[Tensor, "6"] | None:
        """The rotation of the camera at a pixel (x, y), continuous: a, b, c and the angular velocity (3,) about its own
        axes, which has lasted for a x + b y + c seconds. None for a global shutter."""
        if self.shutter is None:
            return None
        readout = self.shutter.readout_s
        times = [readout[0] / self.width, readout[1] / self.height, readout[2] - 0.5 * readout[:2].sum()]
        return torch.cat([torch.stack(times), self.shutter.angular_velocity])

    @property
    def global_shutter(self) -> "View":
        """This view without rolling shutter."""
        return self if self.shutter is None else replace(self, shutter=None)

    def cropped(self, left: int, top: int, width: int, height: int) -> "View":
        """The part of the image whose first pixel is (`left`, `top`), which may lie outside of it."""
        K, shutter = self.K.clone(), self.shutter
        K[0, 2] -= left
        K[1, 2] -= top
        if shutter is not None:
            along_x, along_y, middle = shutter.readout_s
            offset = along_x * ((left + width / 2) / self.width - 0.5) + along_y * (
                (top + height / 2) / self.height - 0.5
            )
            readout = torch.stack([along_x * width / self.width, along_y * height / self.height, middle + offset])
            shutter = replace(shutter, readout_s=readout)
        return replace(self, K=K, width=width, height=height, shutter=shutter)

    def rays(self) -> Float[Tensor, "h w 3"]:
        """The unit viewing direction of every pixel's centre in world coordinates, at the time of its line."""
        x = torch.arange(self.width, device=self.K.device) + 0.5
        y = torch.arange(self.height, device=self.K.device) + 0.5
        grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        directions = torch.cat([(grid - self.K[:2, 2]) / self.K.diagonal()[:2], torch.ones_like(grid[..., :1])], dim=-1)
        if (turning := self.turning_by_line) is not None:
            times = grid @ turning[:2] + turning[2]
            turned = torch.linalg.cross(turning[3:].expand_as(directions), directions)
            directions = directions + times[..., None] * turned
        return torch.nn.functional.normalize(directions @ self.camera_to_world[:3, :3].T, dim=-1)


def view_of(record: TrainingRecord, index: int, device: torch.device) -> View:
    """Image `index` of a training record as a camera."""
    width, height = record.image_size(index)
    return View(
        K=torch.from_numpy(record.Ks[index]).float().to(device),
        camera_to_world=torch.from_numpy(record.camtoworlds[index]).float().to(device),
        width=width,
        height=height,
        time=record.seconds(index),
        camera=record.camera_name(index),
        shutter=rolling_shutter_of(record.shutter(index), device),
        seconds=torch.tensor(record.seconds(index), dtype=torch.float32, device=device),
    )


def rolling_shutter_of(recorded: Shutter | None, device: torch.device) -> RollingShutter | None:
    """The shutter of an image on a device; None for a global shutter."""
    if recorded is None:
        return None
    readout, motion = (torch.from_numpy(values).float().to(device) for values in (recorded.readout_s, recorded.motion))
    return RollingShutter(readout, motion)


class Shown(NamedTuple):
    """Where a view shows Gaussians: `means` in world coordinates, and the factors on their `scales`."""

    means: Float[Tensor, "n 3"]
    scales: Float[Tensor, "n 3"]


def where_seen(gaussians: Gaussians, view: View) -> Shown:
    """The positions and scales with which a camera without rolling shutter sees Gaussians where this view does.

    Each is projected from where it is at the time of its line (`drivesplat.scene.shutter`), and is then moved along its
    ray back to its depth at the timestamp and scaled with it, which changes nothing in the image: Gaussians that
    overlap at a pixel are all seen at the time of its line, and keep the order of the depths they have at one time. The
    displacement has no gradient: those of positions and scales pass.
    """
    if view.shutter is None:
        return Shown(gaussians.means, gaussians.scales)
    with torch.no_grad():
        rotation, center = view.camera_to_world[:3, :3], view.camera_to_world[:3, 3]
        in_camera = (gaussians.means - center) @ rotation
        own = None if gaussians.velocities is None else gaussians.velocities @ rotation
        size, rolling = (view.width, view.height), view.shutter
        moved = displaced(in_camera, rolling.readout_s, rolling.motion, view.K, size, own)
        before = (in_camera[:, 2:] > NEAR) & (moved[:, 2:] > NEAR)
        factor = torch.where(before, in_camera[:, 2:] / moved[:, 2:], 1.0)
        displacement = (factor * moved - in_camera) @ rotation.T
    return Shown(gaussians.means + displacement, gaussians.scales * factor)


def limited_scales(shown: Shown, view: View, max_scale: float) -> Float[Tensor, "n 3"]:
    """The standard deviations of Gaussians in a view, at most `max_scale` times their distance from its camera.

    Splatting linearises the projection at the centre of a Gaussian, and sorts by the depth of its centre. Where it is
    large for its distance, its image is wrong: a disc on the road rises above the road and hides what stands on it.
    """
    distances = (shown.means.detach() - view.camera_to_world[:3, 3]).norm(dim=1, keepdim=True)
    return torch.minimum(shown.scales, max_scale * distances)


def depth_at_lines(depth: Float[Tensor, "h w"], view: View) -> Float[Tensor, "h w"]:
    """The depth of resting surfaces at the time of each line, of their depth at the view's timestamp; 0 stays 0."""
    if view.shutter is None or view.turning_by_line is None:
        return depth
    a, b, c = view.turning_by_line[:3]
    column = torch.arange(view.width, device=depth.device) + 0.5
    row = (torch.arange(view.height, device=depth.device) + 0.5)[:, None]
    x, y = (column - view.K[0, 2]) / view.K[0, 0], (row - view.K[1, 2]) / view.K[1, 1]
    toward = view.shutter.motion[2]
    approach = depth * (toward[0] * x + toward[1] * y + toward[2]) + toward[3]
    return depth + (a * column + b * row + c) * approach * (depth > 0.0)
