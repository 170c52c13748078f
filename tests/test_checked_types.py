"""The tests' own check of types and shapes, which nested functions share."""

from collections.abc import Callable

import numpy as np
import pytest
from helpers.checked_types import CHECKED_CALLS, begin_test, checked
from jaxtyping import Float, TypeCheckError, jaxtyped


def scaling(factor: float, kind: type, **result: object) -> Callable:
    @jaxtyped(typechecker=checked)
    def scaled(values: Float[np.ndarray, " n"], others: Float[np.ndarray, " n"]) -> kind:
        return result.get("returned", kind(factor * (values + others).sum()))

    return scaled


def test_nested_functions_are_checked_by_their_own_annotations():
    for _ in range(2):
        begin_test()
        for factor, kind in ((2.0, float), (3.0, int), (4.0, str)):
            result = scaling(factor, kind)(np.ones(3), np.ones(3))
            assert result == kind(6.0 * factor) and type(result) is kind
            for wrong in (np.ones(2), np.ones((3, 1)), np.arange(3), [1.0, 1.0, 1.0]):
                with pytest.raises(TypeCheckError):
                    scaling(factor, kind)(np.ones(3), wrong)
            with pytest.raises(TypeCheckError):
                scaling(factor, kind, returned=None)(np.ones(3), np.ones(3))


def test_the_first_calls_of_a_function_in_each_test_are_checked():
    @jaxtyped(typechecker=checked)
    def same(value: int) -> int:
        return value

    for _ in range(2):
        begin_test()
        for _ in range(CHECKED_CALLS):
            with pytest.raises(TypeCheckError):
                same("3")
        assert same("3") == "3"


def test_types_that_an_unchecked_call_compares_with_have_lengths_of_their_own():
    @jaxtyped(typechecker=checked)
    def is_vector(values: np.ndarray) -> bool:
        return isinstance(values, Float[np.ndarray, " n"])

    @jaxtyped(typechecker=checked)
    def are_vectors(several: list) -> bool:
        return all(isinstance(values, Float[np.ndarray, " n"]) for values in several)

    @jaxtyped(typechecker=checked)
    def seen_from(values: Float[np.ndarray, " n"], others: list) -> bool:
        return are_vectors(others) and all(map(is_vector, others))

    begin_test()
    for _ in range(CHECKED_CALLS + 1):
        assert is_vector(np.ones(2)) and are_vectors([np.ones(2)])
    assert seen_from(np.ones(3), [np.ones(2)])
