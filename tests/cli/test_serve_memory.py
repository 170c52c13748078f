"""What the command `drivesplat serve` asks of glibc's allocator."""

import ctypes
import os
import subprocess
import sys

import pytest
from helpers import REPOSITORY

from drivesplat.cli import serve

MAPPED = """\
import ctypes
from drivesplat.cli.serve import limit_fragmentation

class Info(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in "arena ordblks smblks hblks a b c d e f".split()]

libc = ctypes.CDLL(None)
libc.mallinfo2.restype, libc.malloc.restype = Info, ctypes.c_void_p
found = [limit_fragmentation(), libc.mallinfo2().hblks]
for _ in range(200):
    libc.malloc(ctypes.c_size_t(100_000))
print(found[0], libc.mallinfo2().hblks - found[1])
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="needs glibc from 2.33 on")
@pytest.mark.parametrize("of_users", [{}, dict.fromkeys(serve.OF_USERS, "131072")])
def test_allocations_above_64_kib_are_mapped_unless_users_set_the_allocator(of_users):
    """100 kB are below the default threshold of glibc, 128 KiB. Some find a place that is free already."""
    environment = {key: value for key, value in os.environ.items() if key not in serve.OF_USERS}
    environment |= {"PYTHONPATH": str(REPOSITORY), **of_users}
    done = subprocess.run([sys.executable, "-c", MAPPED], env=environment, capture_output=True, text=True, check=True)
    does, mapped = done.stdout.split()
    assert (does, int(mapped) > 100) == (("False", False) if of_users else ("True", True)), mapped


def test_other_c_libraries_change_nothing(monkeypatch):
    monkeypatch.setattr(serve.ctypes, "CDLL", lambda _: object())
    for name in serve.OF_USERS:
        monkeypatch.delenv(name, raising=False)
    assert serve.limit_fragmentation() is False
