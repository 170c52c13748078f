"""Commands that compile and cache kernels beforehand."""

import argparse
import logging
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from drivesplat.errors import DriveSplatError


def run_warm_up(module: str, warm_up: Callable[[Path], None], arguments: Sequence[str]) -> int:
    """Runs `warm_up` in an empty folder, without messages of its own, as the command `python -m module`. Returns the
    exit status."""
    argparse.ArgumentParser(f"python -m {module}", description=warm_up.__doc__).parse_args(arguments)
    logging.disable(logging.INFO)
    try:
        with tempfile.TemporaryDirectory() as folder:
            warm_up(Path(folder))
    except DriveSplatError as error:
        print(f"drivesplat: {error}", file=sys.stderr)
        return 1
    return 0
