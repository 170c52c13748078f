"""Prefetching of results and items."""

import threading
import time

import pytest
from helpers.patience import PATIENCE_S

from drivesplat.io.prefetch import prefetch, prefetch_items


def test_results_are_in_order_whatever_their_durations():
    def slow_at_first(item: int) -> int:
        time.sleep(0.02 if item == 0 else 0.0)
        return 10 * item

    assert list(prefetch(slow_at_first, range(20), threads=4)) == [10 * item for item in range(20)]
    assert list(prefetch(slow_at_first, [])) == []


def test_at_most_the_given_number_of_results_is_computed_before_use():
    made = []
    results = prefetch(lambda item: made.append(item) or item, range(100), threads=3)
    for taken in range(1, 6):
        next(results)
        time.sleep(0.01)
        assert len(made) <= taken + 3
    results.close()
    assert len(made) < 10


def test_results_are_computed_in_parallel():
    meeting = threading.Barrier(3, timeout=PATIENCE_S)
    assert list(prefetch(lambda item: meeting.wait() >= 0, range(3), threads=3)) == [True] * 3


def test_an_exception_is_raised_in_place_of_its_result():
    results = prefetch(lambda item: 1 // (item - 2), range(5), threads=2)
    assert [next(results), next(results)] == [-1, -1]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_items_are_prefetched_by_one_thread_while_earlier_ones_are_used():
    made, meeting = [], threading.Barrier(2, timeout=PATIENCE_S)

    def items():
        for item in range(20):
            made.append(threading.get_ident())
            if item == 3:
                meeting.wait()  # until the first is used
            yield item

    given = prefetch_items(items(), at_most=4)
    assert next(given) == 0
    meeting.wait()
    assert list(given) == list(range(1, 20))
    assert len(set(made)) == 1 and made[0] != threading.get_ident()
    assert list(prefetch_items([])) == []
