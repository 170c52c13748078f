"""Work done ahead: by threads, in order, a few items at a time, so that memory does not grow with their number."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

A = TypeVar("A")
B = TypeVar("B")
THREADS = 4
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


def in_advance(items: Iterable[A], at_most: int = THREADS) -> Iterator[A]:
    """`items`, made by one thread while those before them are used, at most so many before they are asked for.

    What making one raises is raised in its place.
    """
    iterator, end = iter(items), object()
    waiting: deque[Future[Any]] = deque()
    with ThreadPoolExecutor(1) as pool:
        try:
            waiting.extend(pool.submit(next, iterator, end) for _ in range(at_most))
            while (item := waiting.popleft().result()) is not end:
                waiting.append(pool.submit(next, iterator, end))
                yield item
        finally:
            for future in waiting:
                future.cancel()
