"""Renderings of a trained model at the images of its scene."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.picture import Picture
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View, view_of
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.scene import Frame
from drivesplat.settings.device import DeviceSettings


@dataclass(frozen=True)
class ModelWithRecording:
    """A trained model with the recording that it was trained on."""

    model: SplatModel
    recording: EvaluationData
    device: torch.device


def open_model_with_recording(
    checkpoint: TrainedCheckpoint, recording: EvaluationData, device_settings: DeviceSettings
) -> ModelWithRecording:
    """The model of a checkpoint on the device, with its recording. Raises DeviceError."""
    model, device = open_model(checkpoint, device_settings)
    return ModelWithRecording(model, recording, device)


@dataclass(frozen=True)
class RenderedView:
    """Renderings of the model of `drive` at the image `index` of the training record."""

    drive: ModelWithRecording
    index: int

    @cached_property
    def camera(self) -> View:
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
            return self.drive.model.gaussians_in(self.camera)

    @torch.no_grad()
    def render(self, rows: Bool[Tensor, " n"] | None = None) -> Picture:
        """The rendering of all `gaussians`, or of those that the mask `rows` selects.

        Raises ResultError if it contains NaN or Inf, DeviceError if the GPU runs out of memory.
        """
        gaussians = self.gaussians if rows is None else self.gaussians[rows]
        with explain_out_of_memory(lambda: len(gaussians)):
            picture = self.drive.model.render(self.camera, gaussians=gaussians)
        if not bool(torch.isfinite(picture.image).all()):
            raise ResultError("the rendering contains NaN or Inf; delete checkpoint.npz and rerun")
        return picture


def colors_of(image: Tensor) -> np.ndarray:
    """Colours (h, w, 3) or opacities (h, w) of a rendering as float64 in [0, 1], on the CPU."""
    return image.double().clamp(0.0, 1.0).cpu().numpy()
