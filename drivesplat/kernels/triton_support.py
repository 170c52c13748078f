"""Whether Triton can be used: it needs a GPU, a C compiler and Python's headers."""

import logging
import os
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any

import torch
from torch import Tensor

log = logging.getLogger(__name__)

SWITCH = "DRIVESPLAT_TRITON"
"""Environment variable; 0 replaces all Triton kernels by torch."""


def usable_for(tensor: Tensor) -> bool:
    """Whether Triton kernels can process a tensor: it is on a GPU, and Triton compiles for it."""
    return tensor.is_cuda and compiles()


def start_check(device: torch.device) -> None:
    """Starts the check of `compiles` in a thread where `device` is a GPU. It takes half a second, in which Triton reads
    its own files."""
    if device.type == "cuda" and not _switched_off():
        _check()


@cache
def compiles() -> bool:
    """Whether Triton compiles for the GPU of this process. Logs one warning where it does not."""
    if _switched_off():
        return False
    reason = _check().result()
    if reason is not None:
        log.warning("Triton cannot be used (%s): trainings take longer; see docs/troubleshooting.md", reason)
    return reason is None


def _switched_off() -> bool:
    return os.environ.get(SWITCH) == "0"


@cache
def _check() -> "Future[str | None]":
    """The result of `problem`, computed once in a thread."""
    return ThreadPoolExecutor(1).submit(problem)


def say_when_compiling() -> None:
    """Logs once that this process compiles kernels, where Triton tells: versions before 3.4 do not."""
    try:
        from triton import knobs
    except ImportError:
        return

    def listen(*, cache_hit: bool, **_: Any) -> None:
        if not cache_hit:
            knobs.compilation.listener = None
            log.info("compiling kernels for this card, about 40 s, once (`drivesplat setup` does it beforehand)")

    knobs.compilation.listener = listen


def problem() -> str | None:
    """Why Triton cannot compile for the GPU of this process; None where it can."""
    try:
        from drivesplat.kernels.triton import probe

        say_when_compiling()
        probe.run()
    except Exception as error:  # no Triton for this system, no C compiler, no headers of Python, an unsupported GPU
        return (str(error).strip().splitlines() or [type(error).__name__])[0]
    return None
