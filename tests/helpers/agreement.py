"""Agreement of two implementations."""

from collections.abc import Mapping

from torch import Tensor


def differing(found: Mapping[str, Tensor], expected: Mapping[str, Tensor], bound: float) -> dict[str, float]:
    """The results that differ by more than `bound` times the largest expected value, and their errors. Shapes and types
    must be equal."""
    errors = {}
    for name, truth in expected.items():
        assert found[name].shape == truth.shape and found[name].dtype == truth.dtype, name
        error = float((found[name] - truth).abs().max()) if truth.numel() else 0.0
        limit = bound * float(truth.abs().max()) if truth.numel() else 0.0
        if not error <= limit:
            errors[name] = error
    return errors
