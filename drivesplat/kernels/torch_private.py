"""torch's private functions, each behind one function of ours. tests/kernels/test_private.py checks their signatures.

There is no public way to update many tensors in one call, to run one fused Adam step, to end a broken capture, or to
load compiled CUDA kernels.
"""

import ctypes
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import torch
from torch import Tensor


def increment(tensors: Sequence[Tensor]) -> None:
    """Adds 1 to every tensor in place, in one call."""
    torch._foreach_add_(tensors, 1)


def copy_all(targets: Sequence[Tensor], sources: Sequence[Tensor]) -> None:
    """Copies every source into its target, in a call for each type of values."""
    for dtype in {source.dtype for source in sources}:
        torch._foreach_copy_(*([values for values in side if values.dtype == dtype] for side in (targets, sources)))


def fused_adam_step(
    parameter: Tensor, gradient: Tensor, state: dict[str, Tensor], rate: float | Tensor, betas: tuple[float, float],
    eps: float,
) -> None:  # fmt: skip
    """One step of torch.optim.Adam with `fused=True`; `state["step"]` is already incremented."""
    torch._fused_adam_(
        [parameter], [gradient], [state["exp_avg"]], [state["exp_avg_sq"]], [], [state["step"]],
        lr=rate, beta1=betas[0], beta2=betas[1], eps=eps, weight_decay=0.0, amsgrad=False, maximize=False,
    )  # fmt: skip


def write_count(tensor: Tensor) -> int:
    """A number that grows with every write to the tensor."""
    return tensor._version


def loaded_cuda(binary: bytes, kernels: Sequence[str]) -> dict[str, Callable[..., None]]:
    """Compiled kernels by name, loaded for the current device. They take the number of blocks, the number of threads of
    a block, and arguments: tensors on the device and integers of 32 bits. They run in the current stream."""
    from torch.cuda import _utils

    loaded, driver = _utils._cuda_load_module(binary, list(kernels)), _utils._get_cuda_library()
    return {name: partial(_launch, driver, loaded[name]) for name in kernels}


def _launch(driver: Any, kernel: Any, blocks: int, threads: int, arguments: Sequence[Tensor | int]) -> None:
    """As a call of torch's own kernel, which opens the driver's library each time."""
    from torch.cuda import _utils

    values = [given if isinstance(given, int) else given.data_ptr() for given in arguments]
    slots = (ctypes.c_uint64 * len(values))(*values)  # integers in their lower halves
    begin, size = ctypes.addressof(slots), ctypes.sizeof(ctypes.c_uint64)
    places = (ctypes.c_void_p * len(values))(*range(begin, begin + size * len(values), size))
    stream = torch.cuda.current_stream()._as_parameter_
    _utils._check_cuda(driver.cuLaunchKernel(kernel.func, blocks, 1, 1, threads, 1, 1, 0, stream, places, None))


def release_graph_pool(device_index: int, pool: tuple[int, int]) -> None:
    """Ends allocation from a CUDA graph's memory pool whose capture broke off, and releases the pool."""
    for name in ("_cuda_endAllocateToPool", "_cuda_releasePool"):
        with suppress(AttributeError, RuntimeError):
            getattr(torch._C, name)(device_index, pool)
