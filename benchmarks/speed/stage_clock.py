"""A clock of the stages of an iteration (`drivesplat.training.step`)."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from drivesplat.training.step import ITERATION, Clock

OTHER = "other"
"""The part of an iteration outside its stages."""


@dataclass(frozen=True)
class Span:
    """One pass through a stage: seconds on the host, and on a GPU the events around its work."""

    name: str
    host: float
    events: tuple[torch.cuda.Event, torch.cuda.Event] | None

    def on_device(self) -> float:
        """Seconds on the device; on a CPU those on the host. The events must have completed."""
        return self.host if self.events is None else 1e-3 * self.events[0].elapsed_time(self.events[1])


@dataclass(frozen=True)
class Share:
    """A stage's mean milliseconds per iteration, on the device and on the host. Where they are equal, the device may
    have waited for Python."""

    device_ms: float
    host_ms: float


class StageClock(Clock):
    """Measures stages after the first `warm_up` iterations; on a GPU by CUDA events, without host synchronisation."""

    def __init__(self, device: torch.device, warm_up: int):
        self._on_gpu = device.type == "cuda"
        self._warm_up = warm_up
        self._spans: list[Span] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        began, first = time.perf_counter(), self._event()
        yield
        last, ended = self._event(), time.perf_counter()
        self._spans.append(Span(name, ended - began, (first, last) if first and last else None))

    def _event(self) -> torch.cuda.Event | None:
        if not self._on_gpu:
            return None
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def shares(self) -> dict[str, Share]:
        """The mean times of every stage, in order of first use, then OTHER, then ITERATION. Empty where no iteration
        was measured."""
        if self._on_gpu:
            torch.cuda.synchronize()
        measured = self._measured()
        count = sum(span.name == ITERATION for span in measured)
        if count == 0:
            return {}
        names = dict.fromkeys(span.name for span in measured if span.name != ITERATION)
        sums = {name: _mean([span for span in measured if span.name == name], count) for name in (*names, ITERATION)}
        whole = sums.pop(ITERATION)
        device, host = (sum(getattr(share, kind) for share in sums.values()) for kind in ("device_ms", "host_ms"))
        return {**sums, OTHER: Share(whole.device_ms - device, whole.host_ms - host), ITERATION: whole}

    def _measured(self) -> list[Span]:
        """The spans of iterations after the warm-up; those of an iteration come before its own."""
        ends = [i for i, span in enumerate(self._spans) if span.name == ITERATION]
        if len(ends) <= self._warm_up:
            return []
        first = ends[self._warm_up - 1] + 1 if self._warm_up else 0
        return self._spans[first : ends[-1] + 1]


def _mean(spans: list[Span], iterations: int) -> Share:
    """The mean times of one stage in so many iterations."""
    device, host = sum(span.on_device() for span in spans), sum(span.host for span in spans)
    return Share(1e3 * device / iterations, 1e3 * host / iterations)
