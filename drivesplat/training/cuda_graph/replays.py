"""Iterations recorded as CUDA graphs and replayed: Python says once what the GPU does with a training image, not a
thousand times.

At 640x360 an iteration's hundreds of kernels take the GPU less time than Python takes to ask for them. A recording
holds on to the addresses of what it reads and writes, so it is of one image, and serves while the model's tensors lie
where they do: their spare rows (`spares`) let Gaussians become more meanwhile. It is made when an image comes again.
"""

import logging
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import TypeVar

import torch
from torch import Tensor

from drivesplat.kernels import capacity as rooms
from drivesplat.kernels import triton as on_gpu
from drivesplat.kernels.cuda_graphs import Graph, Pool, captured, fresh_pool
from drivesplat.settings.train import TrainSettings
from drivesplat.training.coarse_to_fine import TrainingImages

log = logging.getLogger(__name__)

Terms = dict[str, Tensor]
T = TypeVar("T")
MOST_IMAGES = 4096
"""Of trainings with more nothing is recorded: what is known of a moment in time is not kept for more than twice as
many, and recordings of it hold on to where it lies."""


@dataclass(frozen=True)
class Extent:
    """How many Gaussians there are `now`, and how many times as many there may be before tensors lie elsewhere."""

    now: int
    times: float


def can_be_replayed(settings: TrainSettings, images: TrainingImages, device: torch.device) -> bool:
    """Whether iterations can be recorded, and shall be. Densification by gradient reads what they leave behind; classes
    are too many values for the lists whose room is known beforehand."""
    wanted = settings.cuda_graphs and settings.strategy == "mcmc" and len(images.views) <= MOST_IMAGES
    possible = device.type == "cuda" and on_gpu.compiles()
    return wanted and possible and all(view.classes is None for view in images.views)


@dataclass
class Replays:
    """The recordings of a training's iterations, by its images; of a training that has none on a CPU, or by choice."""

    wanted: bool
    device: torch.device
    _shape: Hashable = None
    _needs: dict[Hashable, list[float]] = field(default_factory=dict)
    """How much room the lists of an image needed when that was last asked, a Gaussian."""
    _recorded: dict[Hashable, Graph[Terms]] = field(default_factory=dict)
    _now: int = 1
    _pool: Pool | None = None

    def iterate(self, image: Hashable, shape: Hashable, gaussians: Extent, once: Callable[[], Terms]) -> Terms:
        """An iteration with an image, by what it is known: what is done `once`, or its recording replayed. `shape` is
        what changes where a recording no longer serves."""
        if not self.wanted:
            return once()
        if shape != self._shape:
            self._drop(list(self._recorded))
            self._shape = shape
        self._now = max(1, gaussians.now)
        recording = self._recorded.get(image)
        if recording is None and image in self._needs:
            recording = self._record(image, self._now * gaussians.times, once)
        if recording is None:
            with rooms.counted() as needs:
                terms = self.make_room(once)
            self._needs[image] = [need / self._now for need in needs]
            return terms
        recording.replay()
        return recording.result

    def make_room(self, once: Callable[[], T]) -> T:
        """What is done `once`; where memory does not suffice for it beside recordings, without these from now on."""
        try:
            return once()
        except torch.cuda.OutOfMemoryError:
            if not self._recorded:
                raise
        log.warning("no GPU memory is left for recorded iterations: without them it takes longer; lower train.cap_max")
        self._forget()
        torch.cuda.empty_cache()
        return once()

    def check(self) -> None:
        """Drops what was recorded with too little room, to be recorded with what it needs. Waits for the device."""
        if not self._recorded:
            return
        missing = torch.stack([recording.missing for recording in self._recorded.values()]).tolist()
        short = [image for image, more in zip(self._recorded, missing, strict=True) if more > 0]
        if short:
            log.debug("%d recorded iterations had up to %d entries too few", len(short), max(missing))
        self._drop(short)

    def give_way(self) -> bool:
        """Drops what is recorded, since tensors are about to lie elsewhere; whether anything will be recorded again."""
        self._drop(list(self._recorded))
        return self.wanted

    def _drop(self, images: list[Hashable]) -> None:
        """Drops some recordings; how much room they needed at last stays known. Waits for the device."""
        if not images:
            return
        needs = iter(torch.cat([self._recorded[image].needed for image in images]).tolist())
        for image in images:
            self._needs[image] = [next(needs) / self._now for _ in self._recorded.pop(image).needed]
        if not self._recorded:
            self._pool = None  # torch forgets it with the last recording

    def _forget(self) -> None:
        """Drops all there is: nothing will be recorded any more."""
        self.wanted = False
        if self._recorded:
            torch.cuda.synchronize(self.device)
        self._recorded.clear()
        self._pool = None

    def _record(self, image: Hashable, gaussians: float, once: Callable[[], Terms]) -> Graph[Terms] | None:
        """The recording of an iteration with lists for so many Gaussians, which recording does not do; None, and none
        from now on, where the GPU or its driver refuses."""
        self._pool = self._pool or fresh_pool()
        expected = [int(need * gaussians) for need in self._needs[image]]
        recording = captured(once, expected, self._pool, self.device, "iterations")
        if recording is None:
            self._forget()
        else:
            self._recorded[image] = recording
        return recording
