"""The gradients of Gaussians in an image, from the parts that its tiles have left."""

from typing import no_type_check

import numpy as np

from drivesplat.kernels.cache import kernel
from drivesplat.kernels.numba.tiles import CONIC_XX, CONIC_XY, CONIC_YY, OPACITY

MOMENTS = 6
"""Columns of parts that come before the channels': the exponent's gradients times 1, dx, dy, dx², dx dy and dy²."""


@kernel
@no_type_check
def gather_gradients(
    start, stop, order, shapes, slot_offsets, parts, v_means2d, v_conics, v_opacities, v_values, v_absolute
):
    """Adds up the parts of Gaussians `start` to `stop` in the order of their tiles."""
    channels, width = v_values.shape[1], parts.shape[1]
    total = np.empty(width)
    for r in range(start, stop):
        total[:] = 0.0
        for slot in range(slot_offsets[r], slot_offsets[r + 1]):
            for k in range(width):
                total[k] += parts[slot, k]
        g, shape = order[r], shapes[r]
        v_opacities[g] += total[0] / shape[OPACITY]
        v_means2d[g, 0] += shape[CONIC_XX] * total[1] + shape[CONIC_XY] * total[2]
        v_means2d[g, 1] += shape[CONIC_XY] * total[1] + shape[CONIC_YY] * total[2]
        v_conics[g, 0] -= 0.5 * total[3]
        v_conics[g, 1] -= total[4]
        v_conics[g, 2] -= 0.5 * total[5]
        for k in range(channels):
            v_values[g, k] += total[MOMENTS + k]
        if width > MOMENTS + channels:
            v_absolute[g, 0] += total[MOMENTS + channels]
            v_absolute[g, 1] += total[MOMENTS + channels + 1]
