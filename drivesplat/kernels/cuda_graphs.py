"""GPU work captured as a CUDA graph and replayed: Python launches one graph instead of hundreds of kernels.

A graph keeps the addresses of its inputs and outputs: a replay reads their current content, and overwrites the earlier
result. Captured work must not synchronise with the host; buffers of lists get a planned capacity
(`drivesplat.kernels.capacity`).
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from drivesplat.kernels import capacity, torch_private, triton_support

log = logging.getLogger(__name__)

T = TypeVar("T")
MemoryPool = tuple[int, int]
"""torch's handle of the memory that graphs share."""


@dataclass(frozen=True)
class CudaGraph(Generic[T]):
    """A captured graph. `replay` runs it and overwrites `result`; `needed`, the entries that each of its lists needed;
    and `most`, the largest number that each has needed in any replay. `capacities` are those of the lists."""

    replay: Callable[[], None]
    result: T
    needed: Int[Tensor, " lists"]
    capacities: Sequence[int]
    most: Int[Tensor, " lists"]


def graphs_supported(device: torch.device) -> bool:
    """Whether rasterization on this device can be captured: only Triton's lists need no host synchronisation."""
    return device.type == "cuda" and triton_support.compiles()


@contextmanager
def capture_stream(device: torch.device) -> Iterator[None]:
    """Runs device work of this context in a separate stream. The default stream, and autograd's work there, cannot be
    captured."""
    if device.type != "cuda":
        yield
        return
    default, own = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    own.wait_stream(default)
    with torch.cuda.stream(own):
        yield
    default.wait_stream(own)


def new_pool() -> MemoryPool:
    """A memory pool for graphs. Frees torch's cached memory first, since graphs cannot use it."""
    torch.cuda.empty_cache()
    return torch.cuda.graph_pool_handle()


def capture(
    work: Callable[[], T], needed: Sequence[int], pool: MemoryPool, device: torch.device, what: str,
    errors: str = "global",
) -> CudaGraph[T] | None:  # fmt: skip
    """Captures `work` without running it. Call this within `capture_stream`.

    `needed` are the entries that each list of Gaussians in it needed before, `errors` is torch's `capture_error_mode`.
    Returns None, and logs a warning that names `what`, where the capture fails.
    """
    graph, random_state = torch.cuda.CUDAGraph(), torch.cuda.get_rng_state(device)
    needed_now, most = torch.zeros(2, len(needed), dtype=torch.int32, device=device)
    torch.cuda.current_blas_handle()  # every thread has its own, which cannot be created during a capture
    try:
        with capacity.planned(needed) as lists:
            graph.capture_begin(pool=pool, capture_error_mode=errors)
            try:
                result = work()
                for place, (entries, _) in zip(needed_now, lists, strict=True):
                    place.copy_(entries)
                torch.maximum(most, needed_now, out=most)
            finally:
                graph.capture_end()
        return CudaGraph(graph.replay, result, needed_now, [available for _, available in lists], most)
    except Exception as error:  # of the driver, torch or Triton; the work itself is not affected
        log.warning("%s cannot be captured as a CUDA graph, which takes longer: %s", what, _first_line(error))
    _end_broken_capture(device, pool, random_state)  # after the last reference to the captured tensors
    return None


def retry_without_graphs(work: Callable[[], T], drop_graphs: Callable[[], bool]) -> T:
    """Runs `work`. If GPU memory runs out, calls `drop_graphs` and runs `work` again. Raises torch's OutOfMemoryError
    if `drop_graphs` returns False (there were no graphs), or if memory runs out again."""
    try:
        return work()
    except torch.cuda.OutOfMemoryError:
        if not drop_graphs():
            raise
    torch.cuda.empty_cache()
    return work()


def _first_line(error: Exception) -> str:
    """The first error's first line: an error during a capture makes the end of the capture fail as well."""
    return str(error.__context__ or error).splitlines()[0]


def _end_broken_capture(device: torch.device, pool: MemoryPool, random_state: Tensor) -> None:
    """Restores torch's state after a capture that broke off: its random generator and its memory pool."""
    index = torch.cuda.current_device() if device.index is None else device.index
    generator = torch.Generator(device=device)
    generator.set_state(random_state)
    torch.cuda.default_generators[index].graphsafe_set_state(generator.graphsafe_get_state())
    torch_private.release_graph_pool(index, pool)
