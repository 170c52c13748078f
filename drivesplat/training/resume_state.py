"""The state of an unfinished training, from which only the same training resumes."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from drivesplat.errors import ResultError, TrainingError
from drivesplat.io import checkpoint_file
from drivesplat.io.file_lock import LockHeldError, locked_file
from drivesplat.io.storage import unwritable
from drivesplat.model.part import preallocate
from drivesplat.model.splat_model import SplatModel
from drivesplat.training.densify import Densifier
from drivesplat.training.optimizers import ModelOptimizers

log = logging.getLogger(__name__)


@contextmanager
def training_lock(folder: Path) -> Iterator[None]:
    """Keeps a second trainer out of `folder`; the kernel frees the lock when this process ends, however it ends.

    Raises TrainingError naming the process that holds it, ResultError where the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = locked_file(folder / "lock")
    except OSError as error:
        raise unwritable(folder, error) from error
    except LockHeldError as error:
        raise TrainingError(
            f"process {error.holder} is still training in {folder}; wait for it or end it (kill {error.holder}), "
            "then run again"
        ) from None
    with lock:
        yield


def state_of(
    model: SplatModel, optimizers: ModelOptimizers, densifiers: list[Densifier], device: torch.device
) -> dict[str, Any]:
    """Everything that determines the rest of the training."""
    return {
        "model": {key: value.detach() for key, value in model.state_dict().items()},
        "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.all()},
        "densifiers": [densifier.state for densifier in densifiers],
        "preallocated": [part.preallocated for part in model.parts],
        "random": torch.get_rng_state(),
        "random_cuda": torch.cuda.get_rng_state(device) if device.type == "cuda" else None,
    }


def restore_model(model: SplatModel, state: dict[str, torch.Tensor]) -> None:
    """Loads saved parameters into a model with any number of Gaussians."""
    for name, value in state.items():
        owner_name, _, key = name.rpartition(".")
        owner = model.get_submodule(owner_name)
        buffers = dict(owner.named_buffers(recurse=False))
        if key in buffers:
            buffers[key].copy_(value)
            continue
        old = owner[key]
        owner[key] = torch.nn.Parameter(value.to(old.device), requires_grad=old.requires_grad)


def restore(
    state: dict[str, Any],
    model: SplatModel,
    optimizers: ModelOptimizers,
    densifiers: list[Densifier],
    device: torch.device,
) -> None:
    """The inverse of `state_of`, in place."""
    restore_model(model, state["model"])
    for part, rows in zip(model.parts, state["preallocated"], strict=True):
        preallocate(part, rows)
    parameters = [(part.params, group) for part, group in zip(model.parts, optimizers.parts, strict=True)]
    parameters += [(part.shared, group) for part, group in zip(model.parts, optimizers.shared, strict=True)]
    parameters += [(it.params, optimizers.beside_parts[name]) for name, it in model.beside_parts.items()]
    for params, group in parameters:
        for key, optimizer in group.items():
            optimizer.param_groups[0]["params"] = [params[key]]
    for name, optimizer in optimizers.all():
        optimizer.load_state_dict(state["optimizers"][name])
    for densifier, saved in zip(densifiers, state["densifiers"], strict=True):
        densifier.state = {
            key: value.to(device) if isinstance(value, torch.Tensor) else value for key, value in saved.items()
        }
    torch.set_rng_state(state["random"])
    if device.type == "cuda" and state["random_cuda"] is not None:
        torch.cuda.set_rng_state(state["random_cuda"], device)


def resumable(path: Path, fingerprint: str) -> dict[str, Any] | None:
    """The resume state at `path` if this training wrote it.

    None where there is none; None, with a warning, where it is damaged or belongs to another training. The checksums of
    the array file detect damage; a digest beside it would be out of date after a kill between the two writes.
    """
    if not path.exists():
        return None
    try:
        content = checkpoint_file.load(path, rule="train")
    except ResultError as error:
        log.warning("%s: training starts at 0", error)
        return None
    if content.get("fingerprint") != fingerprint:
        log.warning("%s belongs to other settings, code or inputs: training starts at 0", path)
        return None
    return content
