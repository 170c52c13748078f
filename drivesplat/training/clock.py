"""Where the time of an iteration goes, by its stages; a training is timed only where somebody asks."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass

import torch

ITERATION = "iteration"
"""The stage that holds all others."""
OTHER = "other"
"""What of an iteration belongs to none of its stages."""

_NOTHING = nullcontext()


class Clock:
    """A clock that stands still: what a loop that nobody times is given."""

    def stage(self, name: str) -> AbstractContextManager[None]:
        """A context for a stage of an iteration; stages follow one another within ITERATION."""
        return _NOTHING


UNTIMED = Clock()


@dataclass(frozen=True)
class Span:
    """One pass through a stage: seconds until Python went on, and on a GPU the events around its work."""

    name: str
    host: float
    events: tuple[torch.cuda.Event, torch.cuda.Event] | None

    def on_device(self) -> float:
        """Seconds that the device took, which on a CPU are those of the host. Events must have happened."""
        return self.host if self.events is None else 1e-3 * self.events[0].elapsed_time(self.events[1])


@dataclass(frozen=True)
class Share:
    """A stage's mean milliseconds an iteration: on the device, and until Python went on. Where the second is as long as
    the first, the device may have waited for Python."""

    device_ms: float
    host_ms: float


class StageClock(Clock):
    """Measures stages, the first `warm_up` iterations aside. On a GPU by events in its queue, which nothing waits for
    while the loop runs."""

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
        """The mean share of every stage in the measured iterations, in the order in which they first came: ITERATION
        last, before it OTHER. Empty where no iteration was measured."""
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
    """The share of one stage's passes in so many iterations."""
    device, host = sum(span.on_device() for span in spans), sum(span.host for span in spans)
    return Share(1e3 * device / iterations, 1e3 * host / iterations)
