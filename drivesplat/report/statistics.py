"""Means over scenes with confidence intervals: percentile bootstrap over scenes (Efron 1979)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

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


@dataclass(frozen=True)
class PairedPsnr:
    """PSNRs in dB on one scene, of moving vehicles and of static pixels, by a reference and by another method."""

    reference_moving: float
    reference_static: float
    moving: float
    static: float


def gap_closed(scenes: Sequence[PairedPsnr], random_seed: int) -> dict[str, Any] | None:
    """The `fraction` of a reference's gap that a method closes on moving vehicles, sum(moving_change) / sum(gap) over
    the `scenes` (their number), with the 95 % confidence interval `low` to `high`; no interval for one scene. Static
    pixels do not enter it: a method that only loses there closes nothing. With the mean `moving_change` and
    `static_change` in dB, as of `mean_over_scenes`. None without scenes or if the reference has no gap to close."""
    moving = [pair.moving - pair.reference_moving for pair in scenes]
    changes, gaps = np.array(moving), np.array([pair.reference_static - pair.reference_moving for pair in scenes])
    if not len(scenes) or gaps.sum() <= 0.0:
        return None
    low, high = _interval((changes, gaps), _ratio_of_sums, random_seed)
    fraction = float(changes.sum() / gaps.sum())
    static = [pair.static - pair.reference_static for pair in scenes]
    by_region = {"moving_change": mean_over_scenes(moving, random_seed)}
    by_region["static_change"] = mean_over_scenes(static, random_seed)
    return {"fraction": fraction, "low": low, "high": high, "scenes": len(scenes), **by_region}


def _ratio_of_sums(parts: np.ndarray, wholes: np.ndarray, axis: int = -1) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return parts.sum(axis=axis) / wholes.sum(axis=axis)


def _interval(
    samples: tuple[Any, ...], statistic: Callable[..., Any], random_seed: int
) -> tuple[float | None, float | None]:
    """The bounds of a statistic of paired samples; None where resampled scenes without any gap make it infinite."""
    if len(samples[0]) < 2:
        return None, None
    from scipy.stats import bootstrap  # 0.3 s, which a report of one scene does without

    interval = bootstrap(
        samples, statistic, paired=len(samples) > 1, vectorized=True, method="percentile", n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE, rng=np.random.default_rng(random_seed),
    ).confidence_interval  # fmt: skip
    low, high = (float(bound) if np.isfinite(bound) else None for bound in (interval.low, interval.high))
    return low, high
