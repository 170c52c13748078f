"""Locks on files, which the kernel frees when the process that holds them ends, however it ends."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


class LockHeldError(Exception):
    """Another process holds the lock: its id is `holder`, "unknown" if it wrote none."""

    def __init__(self, holder: str):
        super().__init__(f"process {holder} holds the lock")
        self.holder = holder


def locked_file(path: Path) -> BinaryIO:
    """The open file at `path`, in a folder that exists, with this process's id in it: locked until it is closed.

    Raises LockHeldError; OSError if the file cannot be written.
    """
    file = open(path, "a+b", buffering=0)  # noqa: SIM115 (it is the result)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        file.truncate(0)
        file.write(str(os.getpid()).encode())
    except BlockingIOError:
        with file:
            file.seek(0)
            raise LockHeldError(file.read().decode(errors="replace").strip() or "unknown") from None
    except OSError:
        file.close()
        raise
    return file


@contextmanager
def waiting_for_lock(path: Path) -> Iterator[None]:
    """Holds the lock of the file at `path`, whose folder is made, during the block; waits while another process holds
    it. Raises OSError if the file cannot be written or locked."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)  # a process forked meanwhile has the file open, too
