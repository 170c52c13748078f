"""Standard output of commands: a closed pipe, a full disk and an encoding without all characters are no bugs."""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from drivesplat.io.storage import unwritable


@contextmanager
def standard_output() -> Iterator[None]:
    """A block that prints. Characters that the encoding lacks are escaped; a pipe whose reader has gone ends the block
    without a word. Ends the process with one line where standard output cannot be written."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        yield
        print(end="", flush=True)
    except OSError as error:
        if error.filename is not None:  # of another file
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes what is left at its end
        if not isinstance(error, BrokenPipeError):
            sys.exit(f"drivesplat: {unwritable('standard output', error)}")
