"""The compute device, probed through torch only, so that AMD's builds of torch are treated alike."""

import logging
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module

import torch

from drivesplat.errors import DeviceError
from drivesplat.machine.compute_capability import covers, dotted
from drivesplat.machine.gsplat_build.installed import build_record, compiled_extension, package_folder
from drivesplat.settings.device import DeviceSettings

log = logging.getLogger(__name__)

COMPILE = f"run `make setup` (with a Python of your own: `{sys.executable} -m drivesplat.machine.gsplat_build`)"
REBUILD = "`rm -r .venv; make setup`"


def choose_device(settings: DeviceSettings, min_free_gb: float | None = None) -> torch.device:
    """The torch device to train or render on; `min_free_gb`, if given, replaces the setting of that name.

    Raises DeviceError, with what to do, if there is no usable GPU (unless `cpu` or `any` is set), gsplat cannot be
    imported or run on it, or too little memory is free.
    """
    if settings.kind == "cpu" or (settings.kind == "any" and not torch.cuda.is_available()):
        return torch.device("cpu")
    try:
        _require_gpu(settings.min_free_gb if min_free_gb is None else min_free_gb)
    except DeviceError as error:
        if settings.kind != "any":
            raise
        log.warning("using the CPU: %s", error)
        return torch.device("cpu")
    if settings.max_gb is not None:
        total_gb = torch.cuda.get_device_properties().total_memory / 1e9
        torch.cuda.set_per_process_memory_fraction(min(1.0, settings.max_gb / total_gb))
    return torch.device("cuda")


def flush_denormals() -> None:
    """Lets the CPU compute with denormal numbers as 0, in this thread and in those that it starts later.

    Moments of Adam whose parameters get no gradient for a thousand iterations decay to denormals, with which a CPU
    computes many times slower. A training takes another course with it, since the smallest gradients are lost.
    """
    torch.set_flush_denormal(True)


def _require_gpu(needed_gb: float) -> None:
    if not torch.cuda.is_available():
        has_gpu_support = torch.version.cuda or torch.version.hip
        why = "finds no GPU (driver missing or too old?)" if has_gpu_support else "is built without GPU support"
        raise DeviceError(
            f"no usable GPU: torch {torch.__version__} {why}; "
            "`make doctor` says what to do, or write device: cpu (very slow on real scenes)"
        )
    free_gb = torch.cuda.mem_get_info()[0] / 1e9
    name = torch.cuda.get_device_name()
    if free_gb < needed_gb:
        raise DeviceError(
            f"{name} has {free_gb:.1f} GB of free memory, device.min_free_gb asks for {needed_gb:g}; "
            "end other programs on it, or lower train.cap_max, images.width and device.min_free_gb"
        )
    _require_gsplat()


def _require_gsplat() -> None:
    """Loads gsplat's kernels. Never compiles them, which gsplat would by default, silently and for minutes."""
    loaded = {"gsplat.csrc", "gsplat.cuda._backend"} & sys.modules.keys()
    if torch.version.cuda and not loaded and package_folder() is not None:  # without one, the import reports it
        if compiled_extension() is None:
            raise DeviceError(
                "gsplat is installed, but its CUDA kernels are not compiled for this torch, and runs do not compile "
                f"them: {COMPILE} (minutes, once; it installs nvcc), `make doctor` says what it needs; or write "
                "device: cpu"
            )
        archs, capability = build_record().get("archs"), torch.cuda.get_device_capability()
        if archs and not covers(archs, capability):
            raise DeviceError(
                f"gsplat has been compiled for compute capability {', '.join(archs)}, and "
                f"{torch.cuda.get_device_name()} has {dotted(capability)}: run "
                f'`GSPLAT_ARCHS="{";".join([*archs, dotted(capability)])}" make setup`, or write device: cpu'
            )
    try:
        if torch.version.cuda and "gsplat.cuda._backend" not in sys.modules:
            import_module("gsplat.csrc")  # gsplat would compile kernels that it cannot load
        from drivesplat.kernels.gsplat_private import compiled_kernels

        kernels = compiled_kernels()
    except Exception as error:  # compiled code can fail to load in any way
        raise DeviceError(
            f"gsplat cannot be loaded ({type(error).__name__}: {error}); "
            f"`make doctor` says why, {REBUILD} reinstalls it for this torch and CUDA; or write device: cpu"
        ) from error
    if kernels is None:
        raise DeviceError(
            "gsplat is not compiled and there is no CUDA toolkit (nvcc) to compile it with; "
            f"{COMPILE}, `make doctor` says what that needs; or write device: cpu"
        )


def device_name(device: torch.device) -> str:
    """The name of the device in `train.json`."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"cpu ({platform.machine()})"


@contextmanager
def explain_out_of_memory(gaussians: Callable[[], int]) -> Iterator[None]:
    """Raises an out-of-memory error of the GPU as a DeviceError with what to do; `gaussians` returns their number."""
    try:
        yield
    except torch.cuda.OutOfMemoryError:
        peak = torch.cuda.max_memory_allocated() / 1e9
        raise DeviceError(
            f"out of GPU memory with {gaussians():,} Gaussians (peak {peak:.1f} GB): lower train.cap_max, then "
            "images.width, then the number of cameras or sweeps"
        ) from None
