"""Timing of the stages of an iteration: what a training tells a clock; `benchmarks` has one that measures."""

from contextlib import AbstractContextManager, nullcontext

ITERATION = "iteration"
"""The stage that holds all others."""

_NOTHING = nullcontext()


class Clock:
    """A clock that measures nothing, for a loop without timing."""

    def stage(self, name: str) -> AbstractContextManager[None]:
        """A context for a stage of an iteration; stages follow one another within ITERATION."""
        return _NOTHING


UNTIMED = Clock()
