"""Constant vectors on a device. They are copied there once: a captured iteration cannot copy them."""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor


@cache
def constant(values: tuple[float | int, ...], device: torch.device) -> Float[Tensor, " v"]:
    """The values in single precision. All callers share the tensor: do not write to it."""
    return torch.tensor(values, dtype=torch.float32, device=device)
