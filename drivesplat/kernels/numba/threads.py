"""Kernels distributed over threads.

The kernels release the GIL and run in plain Python threads that start and end within each call. numba's own threading
layers abort either in a forked process (OpenMP) or when two threads render at the same time (workqueue). No thread
outlives a call, so none is lost in a fork.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch


def parallel_for(kernel: Callable[..., None], count: int, chunk: int, *args: Any) -> None:
    """Calls `kernel(start, stop, *args)` for chunks of at most `chunk` items that together cover range(count).

    Uses as many threads as torch; `kernel` must release the GIL. The chunks, and so the results, do not depend on the
    number of threads.
    """
    starts = range(0, count, chunk)
    others = min(torch.get_num_threads(), len(starts)) - 1
    remaining = iter(starts)  # shared: each thread takes the next chunk when it has finished one

    def work() -> None:
        for start in remaining:
            kernel(start, min(start + chunk, count), *args)

    if others <= 0:
        work()
        return
    with ThreadPoolExecutor(others) as pool:
        helpers = [pool.submit(work) for _ in range(others)]
        work()
    for helper in helpers:
        helper.result()  # raises what its chunks raised
