"""How far a long download has come, told now and then."""

import logging
import sys
import time

log = logging.getLogger(__name__)

EVERY_S = 10.0


def tell(message: str) -> None:
    """Puts a line into the log and on the console."""
    log.info(message)
    print(f"drivesplat: {message}", file=sys.stderr, flush=True)


class Progress:
    """Bytes that have come of `total`, of which `done` were there before."""

    def __init__(self, what: str, total: int, done: int = 0):
        self._what, self._total, self._done = what, total, done
        self._begun = self._told = time.monotonic()
        self._since = 0

    def add(self, count: int) -> None:
        """Counts bytes; tells about every ten seconds."""
        self._done += count
        self._since += count
        now = time.monotonic()
        if now - self._told >= EVERY_S:
            self._told = now
            tell(self.line(now - self._begun))

    def line(self, seconds: float) -> str:
        """How far it is, `seconds` after it began."""
        rate = self._since / max(seconds, 1e-9)
        left = (self._total - self._done) / rate if rate > 0 else 0.0
        unit = f"{left / 60:.0f} min" if left >= 120 else f"{left:.0f} s"
        percent = 100 * self._done / self._total
        return f"{self._what}: {percent:.0f} % of {self._total / 1e9:.2f} GB, {rate / 1e6:.1f} MB/s, {unit} left"
