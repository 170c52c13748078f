"""Iterations recorded as CUDA graphs and replayed: Python says once what the GPU does with a training image, not a
thousand times.

At 640x360 an iteration's hundreds of kernels take the GPU less time than Python takes to ask for them. A recording
holds on to the addresses of what it reads and writes, so it is of one image, and of Gaussians whose number stays: it is
made when an image comes again after their number has stayed for a while, and dropped when they become more.
"""

import logging
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import torch
from jaxtyping import Int
from torch import Tensor

from drivesplat import on_gpu
from drivesplat.on_gpu import rooms
from drivesplat.settings.train import TrainSettings

log = logging.getLogger(__name__)

Terms = dict[str, Tensor]
SETTLED = 150
"""Iterations that the number of Gaussians has to have stayed: more than between two densifications."""


@dataclass(frozen=True)
class Recording:
    """How to have the GPU do an iteration again, and where that leaves its loss terms."""

    replay: Callable[[], None]
    terms: Terms


@contextmanager
def own_stream(device: torch.device) -> Iterator[None]:
    """Work for the device goes into a queue of its own: what the usual one is asked for cannot be recorded, nor what
    autograd once did there."""
    if device.type != "cuda":
        yield
        return
    usual, own = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    own.wait_stream(usual)
    with torch.cuda.stream(own):
        yield
    usual.wait_stream(own)


def can_be_replayed(settings: TrainSettings, device: torch.device) -> bool:
    """Whether iterations can be recorded, and shall be: densification by gradient reads what they leave behind."""
    wanted = settings.cuda_graphs and settings.strategy == "mcmc"
    return wanted and device.type == "cuda" and on_gpu.compiles()


class Memory:
    """What all recordings of a training work in, one after the other. It lasts while a recording does, so a small one
    is kept."""

    def __init__(self, device: torch.device):
        self.pool = torch.cuda.graph_pool_handle()
        self._kept = torch.cuda.CUDAGraph()
        self._kept.capture_begin(pool=self.pool)
        self._place = torch.zeros(1, device=device)
        self._kept.capture_end()


def _tidy_up(device: torch.device, memory: Memory | None) -> None:
    """Ends for torch what it still takes for a recording, which broke off: its generator draws again, and memory is
    given back again."""
    index = torch.cuda.current_device() if device.index is None else device.index
    generator = torch.cuda.default_generators[index]
    fresh = torch.Generator(device=device).manual_seed(generator.initial_seed())
    generator.graphsafe_set_state(fresh.graphsafe_get_state())
    end = getattr(torch._C, "_cuda_endAllocateToPool", None)
    if memory is not None and end is not None:
        with suppress(RuntimeError):
            end(index, memory.pool)


@dataclass
class Replays:
    """The recordings of a training's iterations, by its images; of a training that has none on a CPU, or by choice."""

    wanted: bool
    device: torch.device
    missing: Int[Tensor, ""] = field(init=False)
    """By how much the fullest lists of Gaussians outgrew the room that a recording has for them."""
    _shape: Hashable = None
    _since: int = 0
    _needs: dict[int, list[int]] = field(default_factory=dict)
    _recorded: dict[int, Recording] = field(default_factory=dict)
    _memory: Memory | None = None

    def __post_init__(self) -> None:
        self.missing = torch.zeros((), dtype=torch.int32, device=self.device)

    def iterate(
        self, step: int, image: int, shape: Hashable, once: Callable[[], Terms], settled: bool = False
    ) -> Terms:
        """An iteration with an image, known by a number: what is done `once`, or its recording replayed. `shape` is all
        that a recording holds on to, beside the image; `settled` where the number of Gaussians will stay."""
        if not self.wanted:
            return once()
        if shape != self._shape:
            self._forget()
            self._shape, self._since = shape, step
        recording = self._recorded.get(image)
        if recording is None and image in self._needs and (settled or step >= self._since + SETTLED):
            recording = self._record(image, once)
        if recording is None:
            with rooms.counted() as needs:
                terms = once()
            self._needs[image] = needs
            return terms
        recording.replay()
        return recording.terms

    def check(self) -> None:
        """Drops what was recorded with too little room. Waits for the device."""
        if self._recorded and int(self.missing) > 0:
            log.debug("recorded iterations had room for %d entries too few: they are recorded anew", self.missing)
            self._forget()

    def _forget(self) -> None:
        self._recorded.clear()
        self._needs.clear()
        self.missing.zero_()

    def _record(self, image: int, once: Callable[[], Terms]) -> Recording | None:
        """The recording of an iteration, which recording does not do; None, and none from now on, where the GPU or its
        driver refuses."""
        graph = torch.cuda.CUDAGraph()
        try:
            self._memory = self._memory or Memory(self.device)
            with rooms.given(self._needs[image]) as lists:
                graph.capture_begin(pool=self._memory.pool)
                try:
                    terms = once()
                    for needed, room in lists:
                        torch.maximum(self.missing, needed - room, out=self.missing)
                finally:
                    graph.capture_end()
        except RuntimeError as error:
            first = error.__context__ or error  # one that breaks a recording off lets its end fail, too
            log.warning("iterations cannot be recorded, which takes longer: %s", str(first).splitlines()[0])
            self.wanted = False
            self._forget()
            _tidy_up(self.device, self._memory)
            return None
        self._recorded[image] = recording = Recording(graph.replay, terms)
        return recording
