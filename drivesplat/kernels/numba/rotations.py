"""Rotations by quaternions w, x, y, z of any length, and their gradients."""

import math
from typing import no_type_check

from drivesplat.kernels.cache import callee


@callee
@no_type_check
def rotation_entries(quat):
    """The unit quaternion, the norm of `quat`, and its rotation row by row."""
    w, x, y, z = float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    return (
        w, x, y, z, norm,
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@callee
@no_type_check
def quat_gradient(w, x, y, z, norm, row0, row1, row2):
    """The gradient of a quaternion of length `norm`, given its unit quaternion and the gradient of its rotation row by
    row."""
    v00, v01, v02 = row0
    v10, v11, v12 = row1
    v20, v21, v22 = row2
    v_w = 2.0 * (x * (v21 - v12) + y * (v02 - v20) + z * (v10 - v01))
    v_x = 2.0 * (w * (v21 - v12) + y * (v01 + v10) + z * (v02 + v20) - 2.0 * x * (v11 + v22))
    v_y = 2.0 * (w * (v02 - v20) + x * (v01 + v10) + z * (v12 + v21) - 2.0 * y * (v00 + v22))
    v_z = 2.0 * (w * (v10 - v01) + x * (v02 + v20) + y * (v12 + v21) - 2.0 * z * (v00 + v11))
    along = w * v_w + x * v_x + y * v_y + z * v_z
    return (v_w - w * along) / norm, (v_x - x * along) / norm, (v_y - y * along) / norm, (v_z - z * along) / norm
