"""Waits for events, with a limit that no load of the machine reaches."""

import time
from collections.abc import Callable

PATIENCE_S = 600
"""Seconds that an event of milliseconds may take. A test reaches them where it fails, and nowhere else."""
PAUSE_S = 0.02


def wait_until(happens: Callable[[], object]) -> None:
    """Raises AssertionError where it does not happen; the pauses alone take PATIENCE_S."""
    for _ in range(int(PATIENCE_S / PAUSE_S)):
        if happens():
            return
        time.sleep(PAUSE_S)
    raise AssertionError("it never came to this")
