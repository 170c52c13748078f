"""Console and log lines of a download."""

import logging
import sys

from tqdm import tqdm

log = logging.getLogger(__name__)

INTERVAL_S = 10.0
"""Time between two progress lines."""


def announce(message: str) -> None:
    """Writes a line to the log and to the console."""
    log.info(message)
    print(f"drivesplat: {message}", file=sys.stderr, flush=True)


def byte_progress(what: str, total: int, done: int = 0) -> tqdm:
    """The progress up to `total` bytes and the remaining time, for the console; to be updated with new bytes."""
    return tqdm(desc=what, total=total, initial=done, unit="B", unit_scale=True, mininterval=INTERVAL_S)
