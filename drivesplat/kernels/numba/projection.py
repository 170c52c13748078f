"""EWA projection of 3D Gaussians into pinhole cameras, and its gradients (Zwicker et al. 2001; Kerbl et al. 2023).

The covariance in the image is T Tᵀ with T = J W R S: scales S, rotation R, world to camera W and the Jacobian J of the
perspective division. With m the cross product of T's two rows its determinant is |m|², which neither cancels nor turns
negative, as ac - b² does in float32 for needles.

The arithmetic is in float64 whatever the tensors are. `no_type_check` keeps the tests' shape checks off compiled
functions: numba does not see through those.
"""

import math
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.cache import callee, kernel
from drivesplat.kernels.numba.rotations import quat_gradient, rotation_entries
from drivesplat.kernels.numba.threads import parallel_for

EPS2D = 0.3
"""Variance in square pixels that the 2D filter adds."""
NEAR_PLANE = 0.01
FAR_PLANE = 1e10
EXTENT = 3.33
"""Standard deviations at which an opacity of 1 has decreased to 1/255."""
MIN_AREA_RATIO = 1e-12
"""Where the filter leaves less of a Gaussian's area, the compensation is constant: its slope would be infinite."""
MAX_RADIUS = 2**30
CHUNK = 2048
"""Gaussians per chunk; sums over Gaussians are made chunk by chunk."""


class Projection(torch.autograd.Function):
    """Means (c, n, 2) in pixels, depths (c, n), conics (c, n, 3), compensations (c, n) and radii (c, n, 2) in pixels.

    Conics are the upper triangle of the inverse covariance. Compensations are the factors by which `antialiased` lowers
    opacities (Yu et al. 2024, eq. 7). Gaussians out of view have radius 0; those behind the near plane are zeros.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Float[Tensor, "n 3"],
        quats: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
        viewmats: Float[Tensor, "c 4 4"],
        Ks: Float[Tensor, "c 3 3"],
        width: int,
        height: int,
    ) -> tuple[
        Float[Tensor, "c n 2"],
        Float[Tensor, "c n"],
        Float[Tensor, "c n 3"],
        Float[Tensor, "c n"],
        Int[Tensor, "c n 2"],
    ]:
        cameras, n = len(viewmats), len(means)
        outputs = [means.new_empty((cameras, n, *size)) for size in ((2,), (), (3,), ())]
        radii = torch.empty((cameras, n, 2), dtype=torch.int32)
        inputs = arrays(means, quats, scales)
        for c in range(cameras):
            camera = pinhole(viewmats[c], Ks[c], width, height)
            parallel_for(_project, n, CHUNK, *inputs, camera, *arrays(*(o[c] for o in outputs), radii[c]))
        ctx.save_for_backward(means, quats, scales, viewmats, Ks, radii)
        ctx.size = (width, height)
        ctx.mark_non_differentiable(radii)
        return (*outputs, radii)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        means, quats, scales, viewmats, Ks, radii = ctx.saved_tensors
        inputs = arrays(means, quats, scales)
        v_inputs = [torch.zeros_like(value, memory_format=torch.contiguous_format) for value in (means, quats, scales)]
        v_viewmats = torch.zeros_like(viewmats, memory_format=torch.contiguous_format)
        for c in range(len(viewmats)):
            sums = np.zeros((-(-len(means) // CHUNK), 12))
            v_camera = arrays(*(v[c] for v in v_outputs[:4]))
            camera = pinhole(viewmats[c], Ks[c], *ctx.size)
            parallel_for(
                _project_backward, len(means), CHUNK,
                *inputs, camera, radii[c].numpy(), *v_camera, *arrays(*v_inputs), sums,
            )  # fmt: skip
            v_viewmats[c, :3] = torch.from_numpy(sums.sum(axis=0)).reshape(3, 4)
        return (*v_inputs, v_viewmats, None, None, None)


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """The tensors as contiguous numpy arrays: kernels are compiled for no other layout."""
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


def pinhole(viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], width: int, height: int) -> np.ndarray:
    """A camera as one array (24,): rotation (9), translation (3), first two rows of K (6), the lowest and highest x/z,
    then y/z, at which Gaussians are linearised, width and height.

    As in 3D Gaussian Splatting these limits are 30 % of the half image beyond its border.
    """
    k = K.detach().double().numpy()
    size = np.array([width, height])
    focal, principal = k.diagonal()[:2], k[:2, 2]
    margin = 0.3 * 0.5 * size / focal
    limits = np.stack([-principal / focal - margin, (size - principal) / focal + margin], axis=1)
    view = viewmat.detach().double().numpy()
    return np.concatenate([view[:3, :3].ravel(), view[:3, 3], k[:2].ravel(), limits.ravel(), size])


@callee
@no_type_check
def _to_camera(mean, quat, scale, camera, at, axes, in_camera):
    """Writes the mean (3,) in the camera, R S (3, 3) to `axes` and W R S (3, 3) to `in_camera`."""
    r = rotation_entries(quat)[5:]
    for j in range(3):
        for i in range(3):
            axes[i, j] = r[3 * i + j] * scale[j]
    for i in range(3):
        w0, w1, w2 = camera[3 * i], camera[3 * i + 1], camera[3 * i + 2]
        at[i] = w0 * mean[0] + w1 * mean[1] + w2 * mean[2] + camera[9 + i]
        for j in range(3):
            in_camera[i, j] = w0 * axes[0, j] + w1 * axes[1, j] + w2 * axes[2, j]


@callee
@no_type_check
def _to_image(at, in_camera, camera, t):
    """Writes T (2, 3); returns the slopes x/z and y/z at which the Gaussian is linearised and det(T Tᵀ)."""
    slope_x = min(max(at[0] / at[2], camera[18]), camera[19])
    slope_y = min(max(at[1] / at[2], camera[20]), camera[21])
    fx, fy = camera[12] / at[2], camera[16] / at[2]
    for j in range(3):
        t[0, j] = fx * (in_camera[0, j] - slope_x * in_camera[2, j])
        t[1, j] = fy * (in_camera[1, j] - slope_y * in_camera[2, j])
    m0 = t[0, 1] * t[1, 2] - t[0, 2] * t[1, 1]
    m1 = t[0, 2] * t[1, 0] - t[0, 0] * t[1, 2]
    m2 = t[0, 0] * t[1, 1] - t[0, 1] * t[1, 0]
    return slope_x, slope_y, m0 * m0 + m1 * m1 + m2 * m2


@callee
@no_type_check
def _covariance(t):
    """The entries xx, xy and yy of T Tᵀ."""
    xx = t[0, 0] * t[0, 0] + t[0, 1] * t[0, 1] + t[0, 2] * t[0, 2]
    xy = t[0, 0] * t[1, 0] + t[0, 1] * t[1, 1] + t[0, 2] * t[1, 2]
    yy = t[1, 0] * t[1, 0] + t[1, 1] * t[1, 1] + t[1, 2] * t[1, 2]
    return xx, xy, yy


@kernel
@no_type_check
def _project(start, stop, means, quats, scales, camera, means2d, depths, conics, compensations, radii):
    at, axes, in_camera, t = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3))
    for g in range(start, stop):
        _to_camera(means[g], quats[g], scales[g], camera, at, axes, in_camera)
        x, y, z = at[0], at[1], at[2]
        depths[g] = z
        radii[g] = 0
        if not z > NEAR_PLANE:
            means2d[g] = 0.0
            conics[g] = 0.0
            compensations[g] = 0.0
            continue
        _, _, area = _to_image(at, in_camera, camera, t)
        xx, xy, yy = _covariance(t)
        determinant = area + EPS2D * (xx + yy + EPS2D)
        xx, yy = xx + EPS2D, yy + EPS2D
        u = (camera[12] * x + camera[13] * y) / z + camera[14]
        v = (camera[15] * x + camera[16] * y) / z + camera[17]
        means2d[g, 0], means2d[g, 1] = u, v
        conics[g, 0], conics[g, 1], conics[g, 2] = yy / determinant, -xy / determinant, xx / determinant
        compensations[g] = math.sqrt(max(area / determinant, MIN_AREA_RATIO))
        reach_x, reach_y = np.ceil(EXTENT * math.sqrt(xx)), np.ceil(EXTENT * math.sqrt(yy))
        in_view = u + reach_x > 0 and u - reach_x < camera[22] and v + reach_y > 0 and v - reach_y < camera[23]
        if in_view and z < FAR_PLANE:
            radii[g, 0], radii[g, 1] = min(reach_x, MAX_RADIUS), min(reach_y, MAX_RADIUS)


@kernel
@no_type_check
def _project_backward(
    start, stop, means, quats, scales, camera, radii, v_means2d, v_depths, v_conics, v_compensations,
    v_means, v_quats, v_scales, v_viewmat,
):  # fmt: skip
    """Adds to `v_means`, `v_quats` and `v_scales`; writes this chunk's sum for rotation and translation (3, 4)."""
    at, v_at = np.empty(3), np.empty(3)
    axes, in_camera, v_in_camera, v_axes = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    t, v_t, sums = np.empty((2, 3)), np.empty((2, 3)), np.zeros((3, 4))
    for g in range(start, stop):
        if radii[g, 0] == 0 or radii[g, 1] == 0:
            continue
        _to_camera(means[g], quats[g], scales[g], camera, at, axes, in_camera)
        slope_x, slope_y, area = _to_image(at, in_camera, camera, t)
        _covariance_backward(t, area, v_conics[g], v_compensations[g], v_t)
        x, y, z = at[0], at[1], at[2]
        fx, fy = camera[12] / z, camera[16] / z
        v_fx, v_fy, v_slope_x, v_slope_y = 0.0, 0.0, 0.0, 0.0
        for j in range(3):
            v_in_camera[0, j] = fx * v_t[0, j]
            v_in_camera[1, j] = fy * v_t[1, j]
            v_in_camera[2, j] = -fx * slope_x * v_t[0, j] - fy * slope_y * v_t[1, j]
            v_fx += v_t[0, j] * (in_camera[0, j] - slope_x * in_camera[2, j])
            v_fy += v_t[1, j] * (in_camera[1, j] - slope_y * in_camera[2, j])
            v_slope_x -= v_t[0, j] * fx * in_camera[2, j]
            v_slope_y -= v_t[1, j] * fy * in_camera[2, j]
        v_u, v_v = float(v_means2d[g, 0]), float(v_means2d[g, 1])
        v_x_over_z = camera[12] * v_u + camera[15] * v_v
        v_y_over_z = camera[13] * v_u + camera[16] * v_v
        if camera[18] <= x / z <= camera[19]:
            v_x_over_z += v_slope_x
        if camera[20] <= y / z <= camera[21]:
            v_y_over_z += v_slope_y
        v_at[0], v_at[1] = v_x_over_z / z, v_y_over_z / z
        v_at[2] = v_depths[g] - (v_x_over_z * x / z + v_y_over_z * y / z + v_fx * fx + v_fy * fy) / z
        for i in range(3):
            sums[i, 3] += v_at[i]
            for j in range(3):
                sums[i, j] += v_at[i] * means[g, j]
                for k in range(3):
                    sums[i, j] += v_in_camera[i, k] * axes[j, k]
        for j in range(3):
            v_means[g, j] += camera[j] * v_at[0] + camera[3 + j] * v_at[1] + camera[6 + j] * v_at[2]
            for k in range(3):
                v_axes[j, k] = (
                    camera[j] * v_in_camera[0, k]
                    + camera[3 + j] * v_in_camera[1, k]
                    + camera[6 + j] * v_in_camera[2, k]
                )
        _axes_backward(quats[g], scales[g], v_axes, v_quats[g], v_scales[g])
    v_viewmat[start // CHUNK] = sums.ravel()


@callee
@no_type_check
def _covariance_backward(t, area, v_conic, v_compensation, v_t):
    """Writes the gradient of T."""
    xx, xy, yy = _covariance(t)
    determinant = area + EPS2D * (xx + yy + EPS2D)
    v_a, v_b, v_c = v_conic[0] / determinant, v_conic[1] / determinant, v_conic[2] / determinant
    v_determinant = -(v_a * (yy + EPS2D) - v_b * xy + v_c * (xx + EPS2D)) / determinant
    v_area = 0.0
    ratio = area / determinant
    if ratio >= MIN_AREA_RATIO:
        v_area = v_compensation * 0.5 / (math.sqrt(ratio) * determinant)
        v_determinant -= v_area * ratio
    v_area += v_determinant
    v_xx, v_yy, v_xy = v_c + EPS2D * v_determinant, v_a + EPS2D * v_determinant, -v_b
    for j in range(3):
        k, i = (j + 1) % 3, (j + 2) % 3
        # the gradients of |m|² are 2 T1 × m and 2 m × T0
        m_i, m_k = t[0, j] * t[1, k] - t[0, k] * t[1, j], t[0, i] * t[1, j] - t[0, j] * t[1, i]
        v_t[0, j] = 2.0 * v_xx * t[0, j] + v_xy * t[1, j] + 2.0 * v_area * (t[1, k] * m_i - t[1, i] * m_k)
        v_t[1, j] = 2.0 * v_yy * t[1, j] + v_xy * t[0, j] + 2.0 * v_area * (t[0, i] * m_k - t[0, k] * m_i)


@callee
@no_type_check
def _axes_backward(quat, scale, v_axes, v_quat, v_scale):
    """Adds the gradients of R S to those of quaternion and scale."""
    w, x, y, z, norm, r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(quat)
    v_scale[0] += v_axes[0, 0] * r00 + v_axes[1, 0] * r10 + v_axes[2, 0] * r20
    v_scale[1] += v_axes[0, 1] * r01 + v_axes[1, 1] * r11 + v_axes[2, 1] * r21
    v_scale[2] += v_axes[0, 2] * r02 + v_axes[1, 2] * r12 + v_axes[2, 2] * r22
    v00, v01, v02 = v_axes[0, 0] * scale[0], v_axes[0, 1] * scale[1], v_axes[0, 2] * scale[2]
    v10, v11, v12 = v_axes[1, 0] * scale[0], v_axes[1, 1] * scale[1], v_axes[1, 2] * scale[2]
    v20, v21, v22 = v_axes[2, 0] * scale[0], v_axes[2, 1] * scale[1], v_axes[2, 2] * scale[2]
    v_w, v_x, v_y, v_z = quat_gradient(w, x, y, z, norm, (v00, v01, v02), (v10, v11, v12), (v20, v21, v22))
    v_quat[0] += v_w
    v_quat[1] += v_x
    v_quat[2] += v_y
    v_quat[3] += v_z
