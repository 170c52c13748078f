"""Passes over images and Gaussians as Triton kernels: fewer and larger than torch's, and the same within rounding."""

import logging
import os
from functools import cache
from typing import Any

log = logging.getLogger(__name__)

SWITCH = "DRIVESPLAT_TRITON"
"""An environment variable: with 0 torch does all of it."""


def for_tensor(tensor: Any) -> bool:
    """Whether these kernels are there for a tensor, or torch has to do."""
    return tensor.is_cuda and compiles()


@cache
def compiles() -> bool:
    """Whether Triton compiles for the GPU of this process; where it does not, says so once: torch is slower."""
    if os.environ.get(SWITCH) == "0":
        return False
    reason = problem()
    if reason is not None:
        log.warning("Triton cannot be used (%s): trainings take longer; see docs/troubleshooting.md", reason)
    return reason is None


def problem() -> str | None:
    """What keeps Triton from compiling for the GPU of this process; None where it does."""
    try:
        from drivesplat.kernels.triton import trial

        trial.run()
    except Exception as error:  # no Triton for this system, no C compiler, no headers of Python, a GPU it does not know
        return (str(error).strip().splitlines() or [type(error).__name__])[0]
    return None
