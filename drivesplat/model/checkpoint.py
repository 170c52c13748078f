"""The content of checkpoint.npz, and the trained model in it.

The stage `train` makes it (`drivesplat.training.stage`).
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from drivesplat.errors import RequestError, ResultError
from drivesplat.io.array_file import read_arrays, write_arrays
from drivesplat.io.storage import Provenance, unreadable
from drivesplat.io.typed_record import require_finite, typed_record
from drivesplat.kernels import triton_support
from drivesplat.machine.device import choose_device, explain_out_of_memory
from drivesplat.model.build import definitions, rebuild_model
from drivesplat.model.part import PartDefinition
from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.train import TrainJob

RULE, CHECKPOINT = "train", "checkpoint.npz"
UNFINISHED, STATE = "training.npz", "state.npz"
"""Files of an unfinished training: the record that all its states share, and the last state."""


@dataclass(frozen=True)
class TrainedCheckpoint:
    """The content of checkpoint.npz: the `state_dict` of the `model` on the CPU, the settings that it was trained with
    and the definitions of its parts."""

    model: dict[str, torch.Tensor]
    job: TrainJob
    parts: list[PartDefinition]
    provenance: Provenance
    path: str | None = None
    """The file that it was read from."""

    @classmethod
    def of(cls, model: SplatModel, job: TrainJob, provenance: Provenance) -> "TrainedCheckpoint":
        """The checkpoint of a trained model. It shares the memory of a model on the CPU."""
        state = {name: value.detach().cpu() for name, value in model.state_dict().items()}
        return cls(state, job, definitions(model), provenance)


def write_checkpoint(path: str | Path, checkpoint: TrainedCheckpoint) -> None:
    """Writes checkpoint.npz, atomically. Raises ResultError naming `path` where the disk is full."""
    state = {name: value.numpy() for name, value in checkpoint.model.items()}
    content = {"model": state, "parts": checkpoint.parts, "provenance": checkpoint.provenance}
    write_arrays(path, {**content, "job": checkpoint.job.model_dump_json()})


def read_checkpoint(path: str | Path) -> TrainedCheckpoint:
    """Reads checkpoint.npz. Raises ResultError, naming the file and the rule that makes it, where it is not one."""
    content = read_arrays(path, RULE)
    try:
        for name, value in content["model"].items():
            require_finite(name, value)
        state = {name: torch.from_numpy(value) for name, value in content["model"].items()}
        job = TrainJob.model_validate_json(content["job"])
        return typed_record(TrainedCheckpoint, {**content, "model": state, "job": job, "path": str(path)})
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise _no_checkpoint(path, error) from error


def write_training_record(folder: Path, model: SplatModel, job: TrainJob, provenance: Provenance) -> None:
    """Writes what `read_snapshot` needs beside the resume states of a training into its folder."""
    write_checkpoint(folder / UNFINISHED, TrainedCheckpoint({}, job, definitions(model), provenance))


def read_snapshot(folder: Path) -> TrainedCheckpoint:
    """The model of an unfinished training, from the folder of its resume state. Raises ResultError where it is not
    there, or is of another version."""
    checkpoint, path = read_checkpoint(folder / UNFINISHED), folder / STATE
    try:
        saved = read_arrays(path, RULE, torch.from_numpy)["state"]
        state = dict(saved["model"])
        for i, rows in enumerate(saved["preallocated"]):  # these are no Gaussians yet
            own = [name for name in state if name.startswith(f"parts.{i}.params.")] if rows else []
            state |= {name: state[name][:-rows] for name in own}
        for name, value in state.items():
            require_finite(name, value.numpy())
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise _no_checkpoint(path, error) from error
    return replace(checkpoint, model=state, path=str(path))


def _no_checkpoint(path: str | Path, error: Exception) -> ResultError:
    reason = (str(error).strip() or type(error).__name__).splitlines()[0]
    return unreadable(path, RULE, f"not a checkpoint of a finished training ({reason})")


def trained_model(checkpoint: TrainedCheckpoint) -> SplatModel:
    """The model in a checkpoint, on the CPU. Raises ResultError, naming the file and the rule that makes it, where its
    arrays are not those of the model that its settings describe."""
    try:
        return rebuild_model(checkpoint.model, checkpoint.parts, checkpoint.job.sky, checkpoint.job.train)
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        if checkpoint.path is None:
            raise
        raise _no_checkpoint(checkpoint.path, error) from error


def open_model(checkpoint: TrainedCheckpoint, device_settings: DeviceSettings) -> tuple[SplatModel, torch.device]:
    """The model in a checkpoint, without gradients, on the device that the settings choose.

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
    triton_support.start_check(device)
    model = trained_model(checkpoint)
    with explain_out_of_memory(lambda: len(model)):
        return model.to(device).requires_grad_(False), device


def model_file(folder: Path) -> Path:
    """The file of a method's model: its checkpoint, or the last state of a training that runs or was interrupted.
    Raises RequestError where there is neither."""
    for file in (folder / CHECKPOINT, folder / "resume" / STATE):
        if file.is_file():
            return file
    raise RequestError(
        f"{folder} has no checkpoint.npz: name the folder of a method that has been trained, such as "
        "results/demo/street; a training that runs saves its first state after a minute"
    )
