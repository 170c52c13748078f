"""A trained model before one of its scene's images."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import open_model
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import Picture, SplatModel
from drivesplat.model.view import View, view_of
from drivesplat.scene.prepared_drive import Recording
from drivesplat.scene.scene import Frame
from drivesplat.settings.device import DeviceSettings


@dataclass(frozen=True)
class Drive:
    """A trained model with the recording it was trained on."""

    model: SplatModel
    recording: Recording
    device: torch.device


def open_drive(checkpoint: dict[str, Any], recording: Recording, device_settings: DeviceSettings) -> Drive:
    """The model of a checkpoint's content on the device, with its recording."""
    model, device = open_model(checkpoint, device_settings)
    return Drive(model, recording, device)


@dataclass(frozen=True)
class Sight:
    """What the model of `drive` shows at image `index`."""

    drive: Drive
    index: int

    @cached_property
    def view(self) -> View:
        return view_of(self.drive.recording.record, self.index, self.drive.device)

    @property
    def frame(self) -> Frame:
        return self.drive.recording.frame(self.index)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.drive.recording.size(self.index)

    @cached_property
    def gaussians(self) -> Gaussians:
        """The model's Gaussians at the image's time, in world coordinates."""
        with torch.no_grad():
            return self.drive.model.gaussians_at(self.view.time)

    @torch.no_grad()
    def of(self, rows: Bool[Tensor, " n"] | None = None) -> Picture:
        """The picture, of some of `gaussians` alone where `rows` says which.

        Raises ResultError where it is not finite, DeviceError where the card is full.
        """
        shown = self.gaussians if rows is None else self.gaussians[rows]
        with explain_out_of_memory(lambda: len(shown)):
            picture = self.drive.model.render(self.view, gaussians=shown)
        if not bool(torch.isfinite(picture.image).all()):
            raise ResultError("the model shows no numbers; delete its checkpoint.pt and rerun")
        return picture


def colors_of(image: Tensor) -> np.ndarray:
    """A picture's colours (h, w, 3) or opacities (h, w) as float64 in [0, 1], on the CPU."""
    return image.double().clamp(0.0, 1.0).cpu().numpy()
