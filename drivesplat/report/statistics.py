"""Means over scenes with confidence intervals: percentile bootstrap over scenes (Efron 1979)."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import bootstrap

CONFIDENCE = 0.95
RESAMPLES = 9999


def mean_over_scenes(values: Sequence[int | float | None], random_seed: int) -> dict[str, Any] | None:
    """The `mean` of a figure over the `scenes` (their number) in which it is not null, with the 95 % confidence
    interval `low` to `high`; no interval for one scene, None without scenes."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    low, high = _interval((known,), np.mean, random_seed)
    return {"mean": float(np.mean(known)), "low": low, "high": high, "scenes": len(known)}


def gap_closed(
    reference: Sequence[float | None], own: Sequence[float | None], random_seed: int
) -> dict[str, Any] | None:
    """The `fraction` of a reference's gaps that a method closes, 1 - sum(own) / sum(reference), over the `scenes` that
    have both gaps in dB, with the 95 % confidence interval `low` to `high`; no interval for one scene, None without
    scenes or if the reference has no gap to close."""
    pairs = [(a, b) for a, b in zip(reference, own, strict=True) if a is not None and b is not None]
    if not pairs or sum(a for a, _ in pairs) <= 0.0:
        return None
    low, high = _interval(tuple(map(np.array, zip(*pairs, strict=True))), _fraction_closed, random_seed)
    fraction = 1.0 - sum(b for _, b in pairs) / sum(a for a, _ in pairs)
    return {"fraction": fraction, "low": low, "high": high, "scenes": len(pairs)}


def _fraction_closed(reference: np.ndarray, own: np.ndarray, axis: int = -1) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return 1.0 - own.sum(axis=axis) / reference.sum(axis=axis)


def _interval(
    samples: tuple[Any, ...], statistic: Callable[..., Any], random_seed: int
) -> tuple[float | None, float | None]:
    """The bounds of a statistic of paired samples; None where resampled scenes without any gap make it infinite."""
    if len(samples[0]) < 2:
        return None, None
    interval = bootstrap(
        samples, statistic, paired=len(samples) > 1, vectorized=True, method="percentile", n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE, rng=np.random.default_rng(random_seed),
    ).confidence_interval  # fmt: skip
    low, high = (float(bound) if np.isfinite(bound) else None for bound in (interval.low, interval.high))
    return low, high
