"""The worked examples in the documentation of `rasterize` and `rasterize_scan`."""

import doctest

import pytest

from drivesplat.rasterization import rasterization, rasterize, rasterize_scan, scans

SCANS = pytest.param(rasterize_scan, scans, marks=pytest.mark.slow)


@pytest.mark.parametrize(("function", "module"), [(rasterize, rasterization), SCANS])
def test_the_example_runs(function, module):
    (example,) = doctest.DocTestFinder(recurse=False).find(function, function.__name__, module=module, globs={})
    assert len(example.examples) > 8
    assert doctest.DocTestRunner().run(example).failed == 0
