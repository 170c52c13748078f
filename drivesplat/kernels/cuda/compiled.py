"""The compiled CUDA kernels, cached on disk, and whether this process can have them."""

import ctypes
import logging
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from drivesplat.errors import DeviceError
from drivesplat.io.storage import atomic_write
from drivesplat.kernels import torch_private
from drivesplat.kernels.cache_folder import cache_folder
from drivesplat.kernels.cuda import scan_source, source
from drivesplat.provenance.code.code_digest import code_digest

log = logging.getLogger(__name__)

LENGTH = 256
"""Maximum number of Gaussians in a chunk."""


class Program(NamedTuple):
    """CUDA C++ `source`, the names of its kernels, and the name of its files in the cache."""

    name: str
    source: str
    kernels: tuple[str, ...]


IMAGES = Program("images", source.SOURCE, source.KERNELS)
IMAGES_WITH_OBJECTS = Program("images-with-objects", "#define OBJECTS 1\n" + source.SOURCE, source.KERNELS)
SCANS = Program("scans", scan_source.SOURCE, scan_source.KERNELS)
USED = {IMAGES: (1, 3, 4, 5), IMAGES_WITH_OBJECTS: (1, 3, 4, 5), SCANS: (2, 3)}
"""The programs, and the numbers of values for which trainings, evaluations and films usually compile them."""


def usable_for(tensor: Tensor, program: Program) -> bool:
    """Whether the kernels of a program can process a tensor: it is on an NVIDIA GPU, and NVRTC compiles for it."""
    return tensor.is_cuda and torch.version.hip is None and _compiles(program, tensor.device.index)


@cache
def kernels(program: Program, channels: int, length: int, device: int) -> Mapping[str, Callable[..., None]]:
    """The kernels of a program for Gaussians with so many values and chunks of at most `length` of them, loaded for a
    device, by name. Raises RuntimeError or OSError where they cannot be compiled."""
    with torch.cuda.device(device):
        capability = "{}{}".format(*torch.cuda.get_device_capability())
        return torch_private.loaded_cuda(_binary(program, channels, length, capability), program.kernels)


@cache
def _compiles(program: Program, device: int) -> bool:
    try:
        kernels(program, 3, LENGTH, device)
    except (RuntimeError, OSError, AttributeError, ImportError) as error:  # no NVRTC, or another version of torch
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        log.warning("CUDA kernels of %s cannot be compiled (%s): trainings take longer", program.name, reason)
        return False
    return True


def compile_ahead(capability: str) -> int:
    """Compiles the programs of USED for GPUs of a compute capability, such as "90", into the cache, where they are not;
    needs no GPU. Returns their number. Raises DeviceError where NVRTC or the cache cannot be used."""
    wanted = [(program, channels) for program, numbers in USED.items() for channels in numbers]
    try:
        for program, channels in wanted:
            _binary(program, channels, LENGTH, capability)
    except (RuntimeError, OSError) as error:
        raise DeviceError(f"CUDA kernels cannot be compiled for compute capability {capability}: {error}") from error
    return len(wanted)


def _binary(program: Program, channels: int, length: int, capability: str) -> bytes:
    """The compiled kernels, from their file in the cache where there is one."""
    folder = cache_folder("cuda", code_digest(Path(__file__)))
    file = folder / f"{program.name}-{channels}-{length}-sm{capability}-{torch.version.cuda}.cubin"
    try:
        return file.read_bytes()
    except OSError:
        binary = compiled(program, channels, length, capability)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as copy:
            copy.write(binary)
    except OSError as error:
        log.debug("%s: %s: every process compiles", file, error)
    return binary


def compiled(program: Program, channels: int, length: int, capability: str) -> bytes:
    """The kernels compiled by NVRTC for GPUs of a compute capability, such as "90"; needs no GPU. Raises RuntimeError
    with NVRTC's messages, or OSError without NVRTC."""
    nvrtc = ctypes.CDLL(f"libnvrtc.so.{str(torch.version.cuda).partition('.')[0]}")  # loaded by torch already
    handle = ctypes.c_void_p()
    options = [f"--gpu-architecture=sm_{capability}", f"-DCHANNELS={channels}", f"-DLENGTH={length}"]
    arguments = (ctypes.c_char_p * len(options))(*map(str.encode, options))

    def output(name: str) -> bytes:
        size = ctypes.c_size_t()
        status = getattr(nvrtc, f"nvrtcGet{name}Size")(handle, ctypes.byref(size))
        content = ctypes.create_string_buffer(size.value)
        if status or getattr(nvrtc, f"nvrtcGet{name}")(handle, content):
            raise RuntimeError(f"NVRTC does not give its {name}")
        return content.raw

    if nvrtc.nvrtcCreateProgram(ctypes.byref(handle), program.source.encode(), None, 0, None, None):
        raise RuntimeError("NVRTC does not take programs")
    try:
        if nvrtc.nvrtcCompileProgram(handle, len(options), arguments):
            raise RuntimeError(output("ProgramLog").rstrip(b"\0").decode(errors="replace"))
        return output("CUBIN")
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(handle))
