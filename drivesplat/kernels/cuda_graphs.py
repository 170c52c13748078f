"""Work for the GPU captured as a CUDA graph and replayed: Python says once what the GPU does, not a thousand times.

A graph holds on to the addresses of what it reads and writes: it sees what lies there when it is replayed, and leaves
its result where it did before. What is captured must ask the device nothing, nor how many Gaussians tiles list
(`rooms`).
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from drivesplat.kernels import capacity as rooms

log = logging.getLogger(__name__)

T = TypeVar("T")
Pool = tuple[int, int]
"""Memory that graphs work in, as torch knows it."""


@dataclass(frozen=True)
class Graph(Generic[T]):
    """How to have the GPU do something again, and what that leaves, always in the same place: `result`; how many
    entries each of its lists of Gaussians `needed` the last time, of `rooms`; and how many one was ever `missing`."""

    replay: Callable[[], None]
    result: T
    needed: Int[Tensor, " lists"]
    rooms: Sequence[int]
    missing: Int[Tensor, ""]


@contextmanager
def own_stream(device: torch.device) -> Iterator[None]:
    """Work for the device goes into a queue of its own: what the usual one is asked for cannot be captured, nor what
    autograd once did there."""
    if device.type != "cuda":
        yield
        return
    usual, own = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    own.wait_stream(usual)
    with torch.cuda.stream(own):
        yield
    usual.wait_stream(own)


def fresh_pool() -> Pool:
    """Memory for graphs; what torch holds in reserve, which is of no use to them, is given back."""
    torch.cuda.empty_cache()
    return torch.cuda.graph_pool_handle()


def captured(
    once: Callable[[], T], needs: Sequence[int], pool: Pool, device: torch.device, what: str, errors: str = "global"
) -> Graph[T] | None:
    """What is done `once`, which is not done thereby. Within `own_stream`; `needs` are how many entries each list of
    Gaussians that it makes has needed, `errors` is torch's `capture_error_mode`. None, and a warning that names `what`,
    where the GPU or its driver refuses."""
    graph, drawn = torch.cuda.CUDAGraph(), torch.cuda.get_rng_state(device)
    missing = torch.zeros((), dtype=torch.int32, device=device)
    needed_then = torch.zeros(len(needs), dtype=torch.int32, device=device)
    try:
        with rooms.given(needs) as lists:
            graph.capture_begin(pool=pool, capture_error_mode=errors)
            try:
                result = once()
                for place, (needed, room) in zip(needed_then, lists, strict=True):
                    place.copy_(needed)
                    torch.maximum(missing, needed - room, out=missing)
            finally:
                graph.capture_end()
        return Graph(graph.replay, result, needed_then, [room for _, room in lists], missing)
    except Exception as error:  # of the driver's, of torch's, of Triton's: all that is lost is time
        log.warning("%s cannot be recorded, which takes longer: %s", what, _first_line(error))
    _tidy_up(device, pool, drawn)  # when nothing holds on to what was to be captured any more
    return None


def _first_line(error: Exception) -> str:
    """Of what went wrong first: what breaks a capture off lets its end fail, too."""
    return str(error.__context__ or error).splitlines()[0]


def _tidy_up(device: torch.device, pool: Pool, drawn: Tensor) -> None:
    """Ends for torch what it still takes for a capture, which broke off: its generator goes on from what had been
    `drawn`, and memory is given back again."""
    index = torch.cuda.current_device() if device.index is None else device.index
    fresh = torch.Generator(device=device)
    fresh.set_state(drawn)
    torch.cuda.default_generators[index].graphsafe_set_state(fresh.graphsafe_get_state())
    for name in ("_cuda_endAllocateToPool", "_cuda_releasePool"):
        with suppress(AttributeError, RuntimeError):
            getattr(torch._C, name)(index, pool)
