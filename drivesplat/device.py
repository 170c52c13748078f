"""The compute device, probed through torch alone, so that AMD's builds of torch are treated alike."""

import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from drivesplat.errors import DeviceError
from drivesplat.settings.device import DeviceSettings


def choose_device(settings: DeviceSettings, min_free_gb: float | None = None) -> torch.device:
    """The torch device to train or render on; `min_free_gb` stands in for the setting of that name where given.

    Raises DeviceError, saying what to do, where there is no usable GPU (unless `cpu` was written), gsplat is not
    importable or cannot run on it, or too little memory is free.
    """
    if settings.kind == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        build = (
            "is built without GPU support"
            if not (torch.version.cuda or torch.version.hip)
            else "sees no GPU (driver missing or too old?)"
        )
        raise DeviceError(
            f"no usable GPU: torch {torch.__version__} {build}; "
            "fix that, or write device: cpu (very slow on real scenes)"
        )
    free_gb = torch.cuda.mem_get_info()[0] / 1e9
    name = torch.cuda.get_device_name()
    needed_gb = settings.min_free_gb if min_free_gb is None else min_free_gb
    if free_gb < needed_gb:
        raise DeviceError(
            f"{name} has {free_gb:.1f} GB of free memory, device.min_free_gb asks for {needed_gb:g}; "
            "end other programs on it, or lower train.cap_max, images.width and device.min_free_gb"
        )
    _require_gsplat()
    return torch.device("cuda")


def _require_gsplat() -> None:
    try:
        from gsplat.cuda._backend import _C
    except Exception as error:  # its just-in-time build can fail in any way
        raise DeviceError(
            f"gsplat cannot be loaded ({type(error).__name__}: {error}); "
            "reinstall it for this torch and CUDA, or write device: cpu"
        ) from error
    if _C is None:
        raise DeviceError(
            "gsplat is not compiled and there is no CUDA toolkit (nvcc) to compile it with; "
            "install the toolkit that matches torch, or write device: cpu"
        )


def device_name(device: torch.device) -> str:
    """What `train.json` calls the device."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"cpu ({platform.machine()})"


@contextmanager
def telling_out_of_memory(gaussians: Callable[[], int]) -> Iterator[None]:
    """Turns an exhausted GPU into a DeviceError with what lowers the need; `gaussians` counts them when it happens."""
    try:
        yield
    except torch.cuda.OutOfMemoryError:
        peak = torch.cuda.max_memory_allocated() / 1e9
        raise DeviceError(
            f"out of GPU memory with {gaussians():,} Gaussians (peak {peak:.1f} GB): lower train.cap_max, then "
            "images.width, then the number of cameras or sweeps"
        ) from None
