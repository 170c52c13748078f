"""Reading checkpoint.npz and opening the trained model in it."""

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
    """Reads `checkpoint.npz`. Raises ResultError for any other file, and for anything but tensors and plain data in
    it."""
    content = checkpoint_file.load(Path(path), rule="train")
    if not {"model", "job", "parts", "provenance"} <= content.keys():
        raise unreadable(path, "train", "not a checkpoint of a finished training")
    return content


def trained_model(content: dict[str, Any]) -> tuple[SplatModel, TrainJob]:
    """The model in a checkpoint's content, on the CPU, and the settings that it was trained with."""
    job = TrainJob.model_validate_json(content["job"])
    return rebuild_model(content["model"], content["parts"], job.sky, job.train), job


def open_model(checkpoint: dict[str, Any], device_settings: DeviceSettings) -> tuple[SplatModel, torch.device]:
    """The model in a checkpoint's content, without gradients, on the device that the settings choose.

    Raises DeviceError where that device is missing or its memory is exhausted.

    Rendering a camera 1.5 m above the origin that looks along the world's x axis, 2 s after the first image:

    >>> model, device = open_model(read_checkpoint("results/0103/street/checkpoint.npz"), DeviceSettings(kind="cpu"))
    >>> K = torch.tensor([[320.0, 0.0, 320.0], [0.0, 320.0, 180.0], [0.0, 0.0, 1.0]], device=device)
    >>> pose = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]], device=device)
    >>> picture = model.render(View(K, pose, 640, 360, time=2.0), with_depth=True)
    >>> picture.image.shape, picture.depth.shape
    (torch.Size([360, 640, 3]), torch.Size([360, 640]))
    """
    device = choose_device(device_settings, min_free_gb=0.0)
    model, _ = trained_model(checkpoint)
    with explain_out_of_memory(lambda: len(model)):
        return model.to(device).requires_grad_(False), device
