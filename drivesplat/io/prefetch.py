"""Prefetching: threads make a bounded number of items before they are requested, in order."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import repeat, takewhile
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")
THREADS = 4
"""Default number of threads. Decoding and numpy release Python's lock most of the time."""


def prefetch(
    made: Callable[[A], B], items: Iterable[A], threads: int = THREADS, at_most: int | None = None
) -> Iterator[B]:
    """`made` of each item, in order, computed by `threads` threads, `at_most` (default: `threads`) before they are
    requested.

    An exception is raised in place of its item.
    """
    waiting: deque[Future[B]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                if len(waiting) == (at_most or threads):
                    yield waiting.popleft().result()
                waiting.append(pool.submit(made, item))
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def prefetch_items(items: Iterable[A], at_most: int = THREADS) -> Iterator[A]:
    """`items`, made by one thread while earlier ones are used, at most `at_most` before they are requested.

    An exception is raised in place of its item.
    """
    iterator, end = iter(items), object()
    made = prefetch(lambda _: next(iterator, end), repeat(None), threads=1, at_most=at_most + 1)
    yield from takewhile(lambda item: item is not end, made)
