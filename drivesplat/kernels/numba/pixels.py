"""Compositing within tiles, and its gradients: the inner loops, written to be vectorised.

A tile's pixels are planes of one scratch array: pixel p of plane k stands at k * PIXELS + p, so that the compiler sees
loads and stores at constant distances and needs no checks for overlap. A Gaussian is composited on whole rows of the
tile, without branches. Constants are cast to the pixels' type, or arithmetic would be in float64.

The backward pass runs front to back like the forward pass and repeats its decisions exactly. With the loss's gradients
g of a pixel's channels (alpha is one more, of value 1), weights w = T alpha and the remaining sum
R_i = sum over j > i of w_j (g · value_j), the gradient of alpha_i is T_i (g · value_i) - R_i / (1 - alpha_i); the sum
over all j is known from the rendered image (Kerbl et al. 2023 run back to front instead).
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from drivesplat.kernels.cache import callee, fast_callee, kernel
from drivesplat.kernels.numba import layout
from drivesplat.kernels.numba.fast_exp import fast_exp
from drivesplat.kernels.numba.layout import MOMENTS

MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4
PIXELS = layout.TILE_WIDTH * layout.TILE_HEIGHT
ROWS = 2
"""Minimum number of a tile's rows that are composited together: 32 pixels, for loops without a remainder."""
CHECK_EVERY = 16
"""Number of Gaussians between two checks whether all rays of a tile have ended."""
X, Y, TRANSMITTANCE, WEIGHT = range(4)
OUT = 4
"""Plane of alpha in the forward pass, which the channels follow."""
RAW, VALUE, REST, GRADIENT = range(4, 8)
"""Planes of the backward pass; GRADIENT is alpha's, which the channels' follow."""


@njit(nogil=True)
@no_type_check
def start_of(plane):
    """The first index of a plane; unsigned, since signed indices are checked for being negative."""
    return np.uint64(plane * PIXELS)


@callee
@no_type_check
def reached_rows(shape, x0, y0):
    """First and last pixel (excluded) of the rows of a tile that a Gaussian reaches; the tile begins at `x0`, `y0`."""
    a, b, c = float(shape[layout.CONIC_XX]), float(shape[layout.CONIC_XY]), float(shape[layout.CONIC_YY])
    reach = float(shape[layout.RADIUS_Y])
    low, high = -reach, reach
    determinant = a * c - b * b
    if determinant > 0.0 and a > 0.0 and c > 0.0:
        quadratic = float(shape[layout.REACH])
        x_max = math.sqrt(quadratic * c / determinant) + layout.SLACK
        left = max(x0 + 0.5 - shape[layout.MEAN_X], -x_max)
        right = min(x0 + layout.TILE_WIDTH - 0.5 - shape[layout.MEAN_X], x_max)
        turn = b * math.sqrt(quadratic * a / determinant) / a
        x = min(max(-turn, left), right)
        high = (math.sqrt(max(c * quadratic - determinant * x * x, 0.0)) - b * x) / c + layout.SLACK
        x = min(max(turn, left), right)
        low = (-math.sqrt(max(c * quadratic - determinant * x * x, 0.0)) - b * x) / c - layout.SLACK
    top = shape[layout.MEAN_Y] - 0.5 - y0
    begin = max(math.ceil((top + low) / ROWS - (ROWS - 1) / ROWS), 0.0)
    end = min(math.floor((top + high) / ROWS) + 1.0, float(layout.TILE_HEIGHT // ROWS))
    if not begin < end:
        return np.uint64(0), np.uint64(0)
    return np.uint64(int(begin) * (ROWS * layout.TILE_WIDTH)), np.uint64(int(end) * (ROWS * layout.TILE_WIDTH))


@callee
@no_type_check
def begin_tile(s, x0, y0, width, height):
    """Writes the coordinates of the pixels' centres, and transmittance: 1, and 0 outside the image."""
    for p in range(PIXELS):
        x, y = x0 + p % layout.TILE_WIDTH, y0 + p // layout.TILE_WIDTH
        s[X * PIXELS + p], s[Y * PIXELS + p] = x + 0.5, y + 0.5
        s[TRANSMITTANCE * PIXELS + p] = 1.0 if x < width and y < height else 0.0


@callee
@no_type_check
def ended(s):
    """Whether all rays of the tile have ended."""
    total = s[0] * 0
    for p in range(np.uint64(0), np.uint64(PIXELS)):
        total += s[start_of(TRANSMITTANCE) + p]
    return total == 0


@fast_callee
@no_type_check
def gaussian_alpha(dx, dy, a, b, c, opacity):
    """A Gaussian's alpha at an offset from its centre, before it is limited to 0.999; 0 below 1/255."""
    real = type(dx)
    half, zero, far = real(0.5), real(0.0), real(-25.0)
    exponent = -(half * a * dx + b * dy) * dx - half * c * dy * dy
    limited = exponent if exponent > far else far
    limited = limited if limited < zero else zero
    alpha = opacity * fast_exp(limited)
    return alpha if (exponent <= zero) & (alpha >= real(layout.MIN_ALPHA)) else zero


@fast_callee
@no_type_check
def weigh(s, begin, end, shape):
    """Advances the transmittance of pixels `begin` to `end` by one Gaussian, and writes its weights.

    A ray that has ended has transmittance 0.
    """
    real = s.dtype.type
    mean_x, mean_y, opacity = shape[layout.MEAN_X], shape[layout.MEAN_Y], shape[layout.OPACITY]
    a, b, c = shape[layout.CONIC_XX], shape[layout.CONIC_XY], shape[layout.CONIC_YY]
    zero, one, max_alpha, min_transmittance = real(0.0), real(1.0), real(MAX_ALPHA), real(MIN_TRANSMITTANCE)
    for p in range(begin, end):
        alpha = gaussian_alpha(s[start_of(X) + p] - mean_x, s[start_of(Y) + p] - mean_y, a, b, c, opacity)
        alpha = alpha if alpha < max_alpha else max_alpha
        before = s[start_of(TRANSMITTANCE) + p]
        after = before * (one - alpha)
        s[start_of(WEIGHT) + p] = alpha * before if after > min_transmittance else zero
        s[start_of(TRANSMITTANCE) + p] = after if after > min_transmittance else zero


@fast_callee
@no_type_check
def add(s, begin, end, target, source, factor):
    """Adds `factor` times plane `source` to plane `target`."""
    for p in range(begin, end):
        s[start_of(target) + p] += factor * s[start_of(source) + p]


@kernel
@no_type_check
def composite_tiles(start, stop, first, offsets, ranks, shapes, values, columns, image, alpha):
    """Renders tiles first + start to first + stop into `image` (h, w, channels) and `alpha` (h, w, 1)."""
    height, width, channels = image.shape
    s = np.empty((OUT + 1 + channels) * PIXELS, image.dtype)
    for tile in range(start, stop):
        x0, y0 = (first + tile) % columns * layout.TILE_WIDTH, (first + tile) // columns * layout.TILE_HEIGHT
        begin_tile(s, x0, y0, width, height)
        s[OUT * PIXELS :] = 0.0
        for i in range(offsets[tile], offsets[tile + 1]):
            if (i - offsets[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and ended(s):
                break
            r = ranks[i]
            begin, end = reached_rows(shapes[r], x0, y0)
            weigh(s, begin, end, shapes[r])
            add(s, begin, end, OUT, WEIGHT, image.dtype.type(1.0))
            for k in range(channels):
                add(s, begin, end, OUT + 1 + k, WEIGHT, values[r, k])
        for y in range(y0, min(y0 + layout.TILE_HEIGHT, height)):
            for x in range(x0, min(x0 + layout.TILE_WIDTH, width)):
                p = (y - y0) * layout.TILE_WIDTH + x - x0
                alpha[y, x, 0] = s[OUT * PIXELS + p]
                for k in range(channels):
                    image[y, x, k] = s[(OUT + 1 + k) * PIXELS + p]


@callee
@no_type_check
def _begin_gradients(s, x0, y0, image, alpha, v_image, v_alpha):
    """Loads the gradients of a tile's pixels, and the initial REST of its rays."""
    height, width, channels = image.shape
    s[REST * PIXELS :] = 0.0
    for y in range(y0, min(y0 + layout.TILE_HEIGHT, height)):
        for x in range(x0, min(x0 + layout.TILE_WIDTH, width)):
            p = (y - y0) * layout.TILE_WIDTH + x - x0
            s[GRADIENT * PIXELS + p] = v_alpha[y, x, 0]
            rest = alpha[y, x, 0] * v_alpha[y, x, 0]
            for k in range(channels):
                s[(GRADIENT + 1 + k) * PIXELS + p] = v_image[y, x, k]
                rest += image[y, x, k] * v_image[y, x, k]
            s[REST * PIXELS + p] = rest


@fast_callee
@no_type_check
def _begin_backward(s, begin, end, shape):
    """Writes alpha before it is limited to 0.999 to RAW, and the gradient of alpha as a channel to VALUE."""
    mean_x, mean_y, opacity = shape[layout.MEAN_X], shape[layout.MEAN_Y], shape[layout.OPACITY]
    a, b, c = shape[layout.CONIC_XX], shape[layout.CONIC_XY], shape[layout.CONIC_YY]
    for p in range(begin, end):
        s[start_of(RAW) + p] = gaussian_alpha(
            s[start_of(X) + p] - mean_x, s[start_of(Y) + p] - mean_y, a, b, c, opacity
        )
        s[start_of(VALUE) + p] = s[start_of(GRADIENT) + p]


@fast_callee
@no_type_check
def _moments(s, begin, end, shape, out):
    """Advances transmittance and REST, and writes weights, gradients of exponents (to RAW) and their moments."""
    real = s.dtype.type
    mean_x, mean_y = shape[layout.MEAN_X], shape[layout.MEAN_Y]
    zero, one = real(0.0), real(1.0)
    max_alpha, min_transmittance = real(MAX_ALPHA), real(MIN_TRANSMITTANCE)
    m = m_x = m_y = m_xx = m_xy = m_yy = zero
    for p in range(begin, end):
        dx, dy = s[start_of(X) + p] - mean_x, s[start_of(Y) + p] - mean_y
        raw, before, value = s[start_of(RAW) + p], s[start_of(TRANSMITTANCE) + p], s[start_of(VALUE) + p]
        alpha = raw if raw < max_alpha else max_alpha
        after = before * (one - alpha)
        continues = after > min_transmittance
        weight = alpha * before if continues else zero
        rest = s[start_of(REST) + p] - weight * value
        s[start_of(REST) + p] = rest
        s[start_of(WEIGHT) + p] = weight
        s[start_of(TRANSMITTANCE) + p] = after if continues else zero
        v = raw * (before * value - rest / (one - alpha))
        v = v if continues & (raw <= max_alpha) else zero
        s[start_of(RAW) + p] = v
        m += v
        m_x, m_y = m_x + v * dx, m_y + v * dy
        m_xx, m_xy, m_yy = m_xx + v * dx * dx, m_xy + v * dx * dy, m_yy + v * dy * dy
    out[0], out[1], out[2], out[3], out[4], out[5] = m, m_x, m_y, m_xx, m_xy, m_yy


@fast_callee
@no_type_check
def _weighted_sum(s, begin, end, plane):
    """The sum of a plane times the weights."""
    total = s.dtype.type(0.0)
    for p in range(begin, end):
        total += s[start_of(WEIGHT) + p] * s[start_of(plane) + p]
    return total


@fast_callee
@no_type_check
def _absolute_sums(s, begin, end, shape):
    """The sums over pixels of the absolute gradients of the Gaussian's centre."""
    mean_x, mean_y = shape[layout.MEAN_X], shape[layout.MEAN_Y]
    a, b, c = shape[layout.CONIC_XX], shape[layout.CONIC_XY], shape[layout.CONIC_YY]
    total_x = total_y = s.dtype.type(0.0)
    for p in range(begin, end):
        dx, dy = s[start_of(X) + p] - mean_x, s[start_of(Y) + p] - mean_y
        total_x += abs(s[start_of(RAW) + p] * (a * dx + b * dy))
        total_y += abs(s[start_of(RAW) + p] * (b * dx + c * dy))
    return total_x, total_y


@kernel
@no_type_check
def composite_tiles_backward(
    start, stop, first, offsets, ranks, slots, shapes, values, columns, image, alpha, v_image, v_alpha, absolute, sums
):
    """Writes each list entry's share of its Gaussian's gradients to its row of `sums`: moments, channels and, with
    `absolute`, the sums of absolute gradients of the centre. Rows of Gaussians behind the ends of all rays stay as is.
    """
    height, width, channels = image.shape
    s = np.empty((GRADIENT + 1 + channels) * PIXELS, image.dtype)
    for tile in range(start, stop):
        x0, y0 = (first + tile) % columns * layout.TILE_WIDTH, (first + tile) // columns * layout.TILE_HEIGHT
        begin_tile(s, x0, y0, width, height)
        _begin_gradients(s, x0, y0, image, alpha, v_image, v_alpha)
        for i in range(offsets[tile], offsets[tile + 1]):
            if (i - offsets[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and ended(s):
                break
            r, out = ranks[i], sums[slots[i]]
            begin, end = reached_rows(shapes[r], x0, y0)
            _begin_backward(s, begin, end, shapes[r])
            for k in range(channels):
                add(s, begin, end, VALUE, GRADIENT + 1 + k, values[r, k])
            _moments(s, begin, end, shapes[r], out)
            for k in range(channels):
                out[MOMENTS + k] = _weighted_sum(s, begin, end, GRADIENT + 1 + k)
            if absolute:
                out[MOMENTS + channels], out[MOMENTS + channels + 1] = _absolute_sums(s, begin, end, shapes[r])
