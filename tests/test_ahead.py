"""Files read ahead."""

import threading
import time

import pytest

from drivesplat.ahead import ahead


def test_results_come_in_order_however_long_each_takes():
    def slow_at_first(item: int) -> int:
        time.sleep(0.02 if item == 0 else 0.0)
        return 10 * item

    assert list(ahead(slow_at_first, range(20), threads=4)) == [10 * item for item in range(20)]
    assert list(ahead(slow_at_first, [])) == []


def test_no_more_than_asked_for_are_made_before_they_are_taken():
    made = []
    results = ahead(lambda item: made.append(item) or item, range(100), threads=3)
    for taken in range(1, 6):
        next(results)
        time.sleep(0.01)
        assert len(made) <= taken + 3
    results.close()
    assert len(made) < 10


def test_several_are_made_at_once():
    meeting = threading.Barrier(3, timeout=5.0)
    assert list(ahead(lambda item: meeting.wait() >= 0, range(3), threads=3)) == [True] * 3


def test_what_one_raises_is_raised_in_its_place():
    results = ahead(lambda item: 1 // (item - 2), range(5), threads=2)
    assert [next(results), next(results)] == [-1, -1]
    with pytest.raises(ZeroDivisionError):
        next(results)
