"""Means over scenes, and how sure they are: percentile bootstrap, which draws scenes anew (Efron 1979)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import bootstrap

CONFIDENCE = 0.95
RESAMPLES = 9999


def mean_over_scenes(values: Sequence[int | float | None], random_seed: int) -> dict[str, Any] | None:
    """The `mean` of a figure over the `scenes` (their number) in which it is not null, from `low` to `high` with 95 %
    confidence; no interval for one scene, None for none."""
    there = [value for value in values if value is not None]
    if not there:
        return None
    low, high = _interval(there, random_seed)
    return {"mean": float(np.mean(there)), "low": low, "high": high, "scenes": len(there)}


def gap_closed(
    reference: Sequence[float | None], own: Sequence[float | None], random_seed: int
) -> dict[str, Any] | None:
    """The `fraction` of a reference's gaps that a method closes, 1 - sum(own) / sum(reference), over the `scenes` that
    have both gaps in dB, from `low` to `high` with 95 % confidence; no interval for one scene, None where there is
    none, or where the reference has no gap to close."""
    pairs = [(a, b) for a, b in zip(reference, own, strict=True) if a is not None and b is not None]
    if not pairs or sum(a for a, _ in pairs) <= 0.0:
        return None
    low, high = _closed_interval(*map(np.array, zip(*pairs, strict=True)), random_seed)
    fraction = 1.0 - sum(b for _, b in pairs) / sum(a for a, _ in pairs)
    return {"fraction": fraction, "low": low, "high": high, "scenes": len(pairs)}


def _interval(values: Sequence[int | float], random_seed: int) -> tuple[float | None, float | None]:
    if len(values) < 2:
        return None, None
    return _ends(bootstrap((values,), np.mean, **_how(random_seed)).confidence_interval)


def _closed_interval(reference: np.ndarray, own: np.ndarray, random_seed: int) -> tuple[float | None, float | None]:
    if len(reference) < 2:
        return None, None

    def fraction(reference: np.ndarray, own: np.ndarray, axis: int = -1) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return 1.0 - own.sum(axis=axis) / reference.sum(axis=axis)

    return _ends(bootstrap((reference, own), fraction, paired=True, **_how(random_seed)).confidence_interval)


def _how(random_seed: int) -> dict[str, Any]:
    random = np.random.default_rng(random_seed)
    return {
        "confidence_level": CONFIDENCE, "n_resamples": RESAMPLES, "method": "percentile", "vectorized": True,
        "rng": random,
    }  # fmt: skip


def _ends(interval: Any) -> tuple[float | None, float | None]:
    """None where draws of scenes without any gap make an end no number."""
    low, high = (float(end) if np.isfinite(end) else None for end in (interval.low, interval.high))
    return low, high
