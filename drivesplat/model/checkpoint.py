"""A trained model as checkpoint.pt: reading it, and opening the model it holds."""

from pathlib import Path
from typing import Any

import torch

from drivesplat.io import checkpoint_file
from drivesplat.io.storage import unreadable
from drivesplat.machine.device import choose_device, explain_out_of_memory
from drivesplat.model.build import rebuild_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.train import TrainJob


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Reads `checkpoint.pt`. Raises ResultError where it is not one, or holds anything but tensors and plain data."""
    content = checkpoint_file.load(Path(path), rule="train")
    if not {"model", "job", "parts", "provenance"} <= content.keys():
        raise unreadable(path, "train", "not a checkpoint of a finished training")
    return content


def trained_model(content: dict[str, Any]) -> tuple[SplatModel, TrainJob]:
    """The model of a checkpoint's content, on the CPU, and the settings it was trained with."""
    job = TrainJob.model_validate_json(content["job"])
    return rebuild_model(content["model"], content["parts"], job.sky, job.train), job


def open_model(checkpoint: dict[str, Any], device_settings: DeviceSettings) -> tuple[SplatModel, torch.device]:
    """The model of a checkpoint's content, to be looked at, on the device that the settings choose.

    Raises DeviceError where there is none, or its memory is exhausted.
    """
    device = choose_device(device_settings, min_free_gb=0.0)
    model, _ = trained_model(checkpoint)
    with explain_out_of_memory(lambda: len(model)):
        return model.to(device).requires_grad_(False), device
