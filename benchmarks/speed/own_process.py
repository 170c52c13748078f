"""Functions in a new process, which starts and ends with an empty device."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import ParamSpec, TypeVar

from drivesplat.errors import TrainingError

P = ParamSpec("P")
R = TypeVar("R")


def run_in_process(function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Calls a module's function in a new process; returns or raises what it does. Raises TrainingError if the process
    is killed."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(function, *args, **kwargs).result()
        except BrokenProcessPool:
            raise TrainingError(
                "the process of a training was killed, most often because main memory is exhausted: lower "
                "train.cap_max or images.width, or end other programs"
            ) from None
