"""The worked example in the documentation of `rasterize`."""

import doctest

from drivesplat.rasterization import rasterization, rasterize


def test_the_example_of_rasterize_runs():
    (example,) = doctest.DocTestFinder(recurse=False).find(rasterize, "rasterize", module=rasterization, globs={})
    assert len(example.examples) > 8
    assert doctest.DocTestRunner().run(example).failed == 0
