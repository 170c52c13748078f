"""Files read ahead: by threads, in order, a few at a time, so that memory does not grow with how many there are."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")
THREADS = 8
"""Decoding and numpy leave Python's lock to others for most of their time."""


def ahead(made: Callable[[A], B], items: Iterable[A], threads: int = THREADS) -> Iterator[B]:
    """`made` of each item, in order, at most `threads` of them before they are asked for.

    What one raises is raised in its place.
    """
    waiting: deque[Future[B]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                if len(waiting) == threads:
                    yield waiting.popleft().result()
                waiting.append(pool.submit(made, item))
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
