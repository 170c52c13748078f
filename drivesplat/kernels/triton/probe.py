"""A minimal kernel that tests whether Triton compiles and runs on this machine."""

from typing import no_type_check

import torch
import triton
import triton.language as tl


def run() -> None:
    """Compiles and runs the kernel. Raises whatever prevents that."""
    counter = torch.zeros(1, device="cuda")
    _increment[(1,)](counter)
    if float(counter) != 1.0:
        raise RuntimeError("Triton's compiled kernels do not run")


@triton.jit
@no_type_check
def _increment(counter):
    tl.store(counter, tl.load(counter) + 1.0)
