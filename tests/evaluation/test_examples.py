"""The worked examples in the docstrings of evaluation."""

import doctest

import pytest

from drivesplat.evaluation import comparison, metrics


@pytest.mark.parametrize("module", [comparison, metrics], ids=lambda module: module.__name__)
def test_worked_examples_are_correct(module):
    result = doctest.testmod(module)
    assert result.attempted and not result.failed
