"""How busy the processors were with other work while something was timed."""

import os
import resource
import time
from dataclasses import dataclass
from pathlib import Path

STATISTICS = Path("/proc/stat")


@dataclass(frozen=True)
class Moment:
    """Seconds that the processors of this machine have been busy (None where it does not tell), and of those what this
    process and its children that ended have had, at a time."""

    at: float
    busy: float | None
    own: float

    @classmethod
    def now(cls) -> "Moment":
        usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return cls(time.monotonic(), _busy(), sum(usage.ru_utime + usage.ru_stime for usage in usages))


def busy_elsewhere(before: Moment, after: Moment) -> float | None:
    """How many processors on average had other work between two moments; None where it is not known."""
    if before.busy is None or after.busy is None or after.at <= before.at:
        return None
    elsewhere = (after.busy - before.busy) - (after.own - before.own)
    return max(0.0, elsewhere / (after.at - before.at))


def _busy() -> float | None:
    """The time of all processors together that was neither idle nor spent waiting for disks."""
    try:
        _, user, nice, system, _, _, irq, softirq, *_ = STATISTICS.read_text().splitlines()[0].split()
    except (OSError, ValueError, IndexError):
        return None
    return sum(map(int, (user, nice, system, irq, softirq))) / os.sysconf("SC_CLK_TCK")
