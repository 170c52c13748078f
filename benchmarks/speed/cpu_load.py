"""The load of other programs on the processors while something is timed."""

import os
import resource
import time
from dataclasses import dataclass
from pathlib import Path

STATISTICS = Path("/proc/stat")


@dataclass(frozen=True)
class CpuSample:
    """CPU times in seconds: `busy` of all processors (None if the system does not tell), `own` of this process and its
    ended children; `at` is the time of the sample."""

    at: float
    busy: float | None
    own: float

    @classmethod
    def now(cls) -> "CpuSample":
        usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return cls(time.monotonic(), _busy(), sum(usage.ru_utime + usage.ru_stime for usage in usages))


def busy_elsewhere(before: CpuSample, after: CpuSample) -> float | None:
    """The mean number of processors that other programs kept busy between two samples; None if unknown."""
    if before.busy is None or after.busy is None or after.at <= before.at:
        return None
    elsewhere = (after.busy - before.busy) - (after.own - before.own)
    return max(0.0, elsewhere / (after.at - before.at))


def _busy() -> float | None:
    """The time of all processors together, without idle time and waiting for disks."""
    try:
        _, user, nice, system, _, _, irq, softirq, *_ = STATISTICS.read_text().splitlines()[0].split()
    except (OSError, ValueError, IndexError):
        return None
    return sum(map(int, (user, nice, system, irq, softirq))) / os.sysconf("SC_CLK_TCK")
