"""Prefetching: threads compute a bounded number of items before they are requested, in order."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import repeat, takewhile
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")
THREADS = 4
"""Default number of threads. Image decoding and numpy release the GIL most of the time."""


def prefetch(
    function: Callable[[A], B], items: Iterable[A], threads: int = THREADS, at_most: int | None = None
) -> Iterator[B]:
    """Yields `function(item)` for each item, in order. `threads` threads compute at most `at_most` (default: `threads`)
    results before they are requested.

    An exception is raised in place of its result.
    """
    waiting: deque[Future[B]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                if len(waiting) == (at_most or threads):
                    yield waiting.popleft().result()
                waiting.append(pool.submit(function, item))
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def prefetch_items(items: Iterable[A], at_most: int = THREADS) -> Iterator[A]:
    """Yields `items`. One thread produces at most `at_most` of them before they are requested.

    An exception is raised in place of its item.
    """
    iterator, end = iter(items), object()
    fetched = prefetch(lambda _: next(iterator, end), repeat(None), threads=1, at_most=at_most + 1)
    yield from takewhile(lambda item: item is not end, fetched)
