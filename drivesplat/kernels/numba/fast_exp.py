"""The exponential function of float32, written to be vectorised."""

import math
from typing import no_type_check

import numpy as np
from numba import types
from numba.extending import overload


def fast_exp(x):
    """exp(x) for -25 <= x <= 0; callable from kernels only."""


@overload(fast_exp)
@no_type_check
def _fast_exp_overload(x):
    if x != types.float32:
        return lambda x: math.exp(x)

    def single(x):
        # 2^n 2^f with n whole and |f| <= 1/2, by a Taylor polynomial; relative error 2e-7
        exponent = x * np.float32(1.4426950408889634)
        n = np.int32(exponent - np.float32(0.5))
        f = exponent - np.float32(n)
        power = np.float32(1.5403530e-4)
        power = power * f + np.float32(1.3333558e-3)
        power = power * f + np.float32(9.6181291e-3)
        power = power * f + np.float32(5.5504109e-2)
        power = power * f + np.float32(2.4022651e-1)
        power = power * f + np.float32(6.9314718e-1)
        power = power * f + np.float32(1.0)
        return power * np.int32((n + np.int32(127)) << np.int32(23)).view(np.float32)

    return single
