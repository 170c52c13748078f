"""A Gaussian before a pinhole camera: its centre and axes in the camera's frame, and its covariance in the image.

With the rotation W from world to camera, a Gaussian's rotation R and its scales S, the rows c of W R S give the rows p
and q of T = J W R S, and the covariance in the image is T Tᵀ. Its determinant is |p × q|².
"""

from typing import no_type_check

import triton
import triton.language as tl

from drivesplat.kernels.triton.vectors import added, cross, dot, rotation_rows, scaled, times, turned, turned_back

EPS2D = tl.constexpr(0.3)
"""Variance in square pixels that the 2D filter adds, as in gsplat."""
MARGIN = tl.constexpr(0.15)
"""The slope at which a Gaussian beside the image is linearised is clamped this fraction of the image's size beyond its
border, 0.3 of half the size, as in gsplat."""


@triton.jit
@no_type_check
def rotation(viewmat):
    """The rows of the rotation from world to camera."""
    return (
        (tl.load(viewmat), tl.load(viewmat + 1), tl.load(viewmat + 2)),
        (tl.load(viewmat + 4), tl.load(viewmat + 5), tl.load(viewmat + 6)),
        (tl.load(viewmat + 8), tl.load(viewmat + 9), tl.load(viewmat + 10)),
    )


@triton.jit
@no_type_check
def in_camera(mean, viewmat):
    """Centres in the camera's frame."""
    shift = tl.load(viewmat + 3), tl.load(viewmat + 7), tl.load(viewmat + 11)
    return added(turned(rotation(viewmat), mean), shift)


@triton.jit
@no_type_check
def axes_in_camera(quat, size, viewmat):
    """The rows of W R S."""
    rows = rotation_rows(quat[0], quat[1], quat[2], quat[3])
    to_camera = rotation(viewmat)
    return (
        times(turned_back(rows, to_camera[0]), size),
        times(turned_back(rows, to_camera[1]), size),
        times(turned_back(rows, to_camera[2]), size),
    )


@triton.jit
@no_type_check
def _slope(along, z, focal, center, extent):
    """The slope along / z, clamped to the image and MARGIN beyond it, and whether it lies within these limits."""
    slope, margin = along / z, MARGIN * extent / focal
    clamped = tl.minimum(tl.maximum(slope, -center / focal - margin), (extent - center) / focal + margin)
    return clamped, clamped == slope


@triton.jit
@no_type_check
def in_image(axes, at, K, width, height):
    """The rows p and q of T, and the slopes x / z and y / z, each as `_slope` returns it."""
    fx, cx, fy, cy = tl.load(K), tl.load(K + 2), tl.load(K + 4), tl.load(K + 5)
    across, within_x = _slope(at[0], at[2], fx, cx, width)
    down, within_y = _slope(at[1], at[2], fy, cy, height)
    p = scaled(fx / at[2], added(axes[0], scaled(-across, axes[2])))
    q = scaled(fy / at[2], added(axes[1], scaled(-down, axes[2])))
    return p, q, across, within_x, down, within_y


@triton.jit
@no_type_check
def covariance(p, q):
    """The entries xx, xy and yy of the filtered covariance, its determinant, and p × q."""
    normal = cross(p, q)
    xx, yy = dot(p, p), dot(q, q)
    determinant = dot(normal, normal) + EPS2D * (xx + yy + EPS2D)
    return xx + EPS2D, dot(p, q), yy + EPS2D, determinant, normal
