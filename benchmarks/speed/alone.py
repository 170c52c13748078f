"""Work in a process of its own: it begins with an empty device, and leaves one."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import ParamSpec, TypeVar

from drivesplat.errors import TrainingError

P = ParamSpec("P")
R = TypeVar("R")


def in_own_process(function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """What a function of a module returns or raises, called in a new process. Raises TrainingError where that process
    is killed."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(function, *args, **kwargs).result()
        except BrokenProcessPool:
            raise TrainingError(
                "the process of a training was killed, most often because main memory is exhausted: lower "
                "train.cap_max or images.width, or end other programs"
            ) from None
