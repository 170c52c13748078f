"""Console and log lines of a download."""

import logging
import sys
import time

log = logging.getLogger(__name__)

INTERVAL_S = 10.0
"""Time between two progress lines."""


def announce(message: str) -> None:
    """Writes a line to the log and to the console."""
    log.info(message)
    print(f"drivesplat: {message}", file=sys.stderr, flush=True)


class ByteProgress:
    """Counts bytes up to `total`, starting at `done`, and announces progress and remaining time."""

    def __init__(self, what: str, total: int, done: int = 0):
        self._what, self._total, self._done = what, total, done
        self._start = self._announced = time.monotonic()
        self._new = 0

    def add(self, count: int) -> None:
        self._done += count
        self._new += count
        now = time.monotonic()
        if now - self._announced >= INTERVAL_S:
            self._announced = now
            announce(self.line(now - self._start))

    def line(self, seconds: float) -> str:
        """The progress line, `seconds` after the start."""
        rate = self._new / max(seconds, 1e-9)
        left = (self._total - self._done) / rate if rate > 0 else 0.0
        unit = f"{left / 60:.0f} min" if left >= 120 else f"{left:.0f} s"
        percent = 100 * self._done / self._total
        return f"{self._what}: {percent:.0f} % of {self._total / 1e9:.2f} GB, {rate / 1e6:.1f} MB/s, {unit} left"
