"""A job that compiles Triton's kernels says so once in its log."""

import logging

import pytest

from drivesplat.kernels.triton_support import say_when_compiling

knobs = pytest.importorskip("triton.knobs", reason="no Triton, or one before 3.4")


def test_a_job_says_once_that_it_compiles_and_nothing_of_kernels_in_the_cache(caplog, monkeypatch):
    monkeypatch.setattr(knobs.compilation, "listener", None)
    caplog.set_level(logging.INFO)
    say_when_compiling()
    found = {"src": None, "metadata": {}, "metadata_group": {}, "times": None}
    for hit in (True, False, False):
        if knobs.compilation.listener is not None:
            knobs.compilation.listener(**found, cache_hit=hit)
    assert [record.message.startswith("compiling kernels for this card") for record in caplog.records] == [True]
    assert knobs.compilation.listener is None
