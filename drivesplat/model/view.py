"""A camera at a time."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.scene.training_record import TrainingRecord


@dataclass(frozen=True)
class View:
    """A camera at a time: `K` in continuous pixels, `time` in seconds since the first image. `camera` names the camera
    of the rig whose exposure applies; None: that of the reference camera, the model's own colours."""

    K: Float[Tensor, "3 3"]
    camera_to_world: Float[Tensor, "4 4"]
    width: int
    height: int
    time: float
    camera: str | None = None

    @cached_property
    def viewmat(self) -> Float[Tensor, "4 4"]:
        """World to camera."""
        rotation_t = self.camera_to_world[:3, :3].T
        upper = torch.cat([rotation_t, -rotation_t @ self.camera_to_world[:3, 3:]], dim=1)
        return torch.cat([upper, torch.eye(4, device=upper.device, dtype=upper.dtype)[3:]])

    def rays(self) -> Float[Tensor, "h w 3"]:
        """The unit viewing direction of every pixel's centre in world coordinates."""
        x = torch.arange(self.width, device=self.K.device) + 0.5
        y = torch.arange(self.height, device=self.K.device) + 0.5
        grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        directions = torch.cat([(grid - self.K[:2, 2]) / self.K.diagonal()[:2], torch.ones_like(grid[..., :1])], dim=-1)
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
    )
