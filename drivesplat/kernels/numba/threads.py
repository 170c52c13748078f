"""Kernels spread over threads.

The kernels release the GIL and are called from plain Python threads, begun and ended within each call, and not from
numba's own threading layers: those either abort in a forked process (OpenMP) or when two threads render at once
(workqueue). Nothing here outlives a call, so a fork finds nothing to inherit.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch


def parallel_for(piece: Callable[..., None], count: int, grain: int, *args: Any) -> None:
    """Calls `piece(start, stop, *args)` for pieces of at most `grain` items that together make up range(count).

    As many threads as torch uses take the pieces; `piece` must release the GIL. The pieces do not depend on the
    number of threads, so neither need the results.
    """
    starts = range(0, count, grain)
    others = min(torch.get_num_threads(), len(starts)) - 1
    left = iter(starts)  # one for all threads: each takes the next piece when it is done with its own

    def work() -> None:
        for start in left:
            piece(start, min(start + grain, count), *args)

    if others <= 0:
        work()
        return
    with ThreadPoolExecutor(others) as pool:
        helpers = [pool.submit(work) for _ in range(others)]
        work()
    for helper in helpers:
        helper.result()  # what a piece raises is raised here
