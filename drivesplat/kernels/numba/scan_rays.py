"""Compositing within the tiles of a LiDAR scan, and its gradients: the inner loops, written to be vectorised.

As pixels.py, with rays for pixels: a tile's rays are planes of one scratch array, ray p of plane k at k * RAYS + p, and
a Gaussian is composited on whole beams of the tile, without branches. Two sums differ: that of ranges, whose value
range + slopes · offset (limited) depends on the ray, and that of alpha in front of `until`.
"""

import math
from typing import no_type_check

import numpy as np

from drivesplat.kernels.cache import callee, fast_callee, kernel
from drivesplat.kernels.numba import scan_tiles
from drivesplat.kernels.numba.pixels import (
    CHECK_EVERY,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    gaussian_alpha,
)
from drivesplat.kernels.numba.scan_tiles import BEAMS, FIRINGS, SLACK, span, wrap

RAYS = BEAMS * FIRINGS
X, Y, TRANSMITTANCE, WEIGHT, UNTIL = range(5)
MEDIAN, ALPHA, BEFORE, RANGE_SUM = range(5, 9)
"""Planes of the forward pass, which the channels follow."""
RAW, VALUE, REST, ALPHA_GRADIENT, BEFORE_GRADIENT, RANGE_GRADIENT = range(5, 11)
"""Planes of the backward pass, which the channels' gradients follow."""
MOMENTS = 10
"""First columns of an entry's gradients: those of the exponent times 1, da, de, da², da de and de²; of the range; and,
of rays whose range is not limited, of the range times 1, da and de. The channels' follow."""


@callee
@no_type_check
def _at(plane):
    """The first index of a plane; unsigned, since signed indices are checked for being negative."""
    return np.uint64(plane * RAYS)


@callee
@no_type_check
def _beams(shape, center, half_width, beam_lows, beam_highs):
    """First and last ray (excluded) of the beams of a tile that a Gaussian reaches."""
    a, b, c = (float(shape[scan_tiles.CONIC_AA]), float(shape[scan_tiles.CONIC_AE]), float(shape[scan_tiles.CONIC_EE]))
    left, right = -math.pi, math.pi
    offset = wrap(center - float(shape[scan_tiles.AZIMUTH]))
    if abs(offset) + half_width < math.pi:  # else the tile's rays are on both sides of the Gaussian
        left, right = offset - half_width, offset + half_width
    reach, radius = float(shape[scan_tiles.REACH]), float(shape[scan_tiles.RADIUS_E]) * scan_tiles.RADIUS_MARGIN
    bottom, top = span(c, b, a, reach, left, right, radius)
    begin, end = 0, 0
    if bottom <= top:
        bottom, top = shape[scan_tiles.ELEVATION] + bottom - SLACK, shape[scan_tiles.ELEVATION] + top + SLACK
        for beam in range(BEAMS):
            if beam_lows[beam] <= top and beam_highs[beam] >= bottom:
                begin = begin if end else beam
                end = beam + 1
    return np.uint64(begin * FIRINGS), np.uint64(end * FIRINGS)


@callee
@no_type_check
def _begin_tile(s, beam, firing, azimuths, elevations, until):
    """Loads a tile's rays, and transmittance: 1, and 0 beyond the scan. Clears all other planes."""
    s[:] = 0.0
    for i in range(beam, min(beam + BEAMS, azimuths.shape[0])):
        for j in range(firing, min(firing + FIRINGS, azimuths.shape[1])):
            p = (i - beam) * FIRINGS + j - firing
            s[X * RAYS + p], s[Y * RAYS + p] = azimuths[i, j], elevations[i, j]
            s[UNTIL * RAYS + p], s[TRANSMITTANCE * RAYS + p] = until[i, j], 1.0


@callee
@no_type_check
def _ended(s):
    """Whether all rays of the tile have ended."""
    total = s[0] * 0
    for p in range(np.uint64(0), np.uint64(RAYS)):
        total += s[_at(TRANSMITTANCE) + p]
    return total == 0


@fast_callee
@no_type_check
def _around(da):
    """A difference of azimuths within ±π."""
    real = type(da)
    half, whole = real(math.pi), real(2.0 * math.pi)
    da = da - whole if da > half else da
    return da + whole if da < -half else da


@fast_callee
@no_type_check
def _correction(da, de, slope_a, slope_e):
    """How much farther than its centre a Gaussian is on a ray, before this is limited."""
    return slope_a * da + slope_e * de


@fast_callee
@no_type_check
def _limited(value, limit):
    value = value if value < limit else limit
    return value if value > -limit else -limit


@fast_callee
@no_type_check
def _weigh(s, begin, end, shape):
    """Composites one Gaussian on rays `begin` to `end`, but for its values, and writes its weights.

    A ray that has ended has transmittance 0.
    """
    real = s.dtype.type
    azimuth, elevation = shape[scan_tiles.AZIMUTH], shape[scan_tiles.ELEVATION]
    a, b, c = shape[scan_tiles.CONIC_AA], shape[scan_tiles.CONIC_AE], shape[scan_tiles.CONIC_EE]
    opacity, center, limit = shape[scan_tiles.OPACITY], shape[scan_tiles.RANGE], shape[scan_tiles.RANGE_LIMIT]
    slope_a, slope_e = shape[scan_tiles.SLOPE_A], shape[scan_tiles.SLOPE_E]
    zero, half, one = real(0.0), real(0.5), real(1.0)
    max_alpha, min_transmittance = real(MAX_ALPHA), real(MIN_TRANSMITTANCE)
    for p in range(begin, end):
        da, de = _around(s[_at(X) + p] - azimuth), s[_at(Y) + p] - elevation
        alpha = gaussian_alpha(da, de, a, b, c, opacity)
        alpha = alpha if alpha < max_alpha else max_alpha
        before = s[_at(TRANSMITTANCE) + p]
        after = before * (one - alpha)
        continues = after > min_transmittance
        weight = alpha * before if continues else zero
        distance = center + _limited(_correction(da, de, slope_a, slope_e), limit)
        s[_at(WEIGHT) + p] = weight
        s[_at(TRANSMITTANCE) + p] = after if continues else zero
        s[_at(ALPHA) + p] += weight
        s[_at(RANGE_SUM) + p] += weight * distance
        s[_at(BEFORE) + p] += weight if distance < s[_at(UNTIL) + p] else zero
        crosses = (before > half) & (after <= half)
        s[_at(MEDIAN) + p] = distance if crosses else s[_at(MEDIAN) + p]


@fast_callee
@no_type_check
def _add(s, begin, end, target, source, factor):
    """Adds `factor` times plane `source` to plane `target`."""
    for p in range(begin, end):
        s[_at(target) + p] += factor * s[_at(source) + p]


@kernel
@no_type_check
def composite_rays(
    start, stop, first, offsets, ranks, shapes, values, centers, half_widths, beam_lows, beam_highs,
    azimuths, elevations, until, range_sum, alpha, before, median, out,
):  # fmt: skip
    """Renders tiles first + start to first + stop into the last five arrays (b, a) and (b, a, channels)."""
    beams, firings, channels = out.shape
    columns = centers.shape[1]
    s = np.empty((RANGE_SUM + 1 + channels) * RAYS, out.dtype)
    for tile in range(start, stop):
        row, column = (first + tile) // columns, (first + tile) % columns
        beam, firing = row * BEAMS, column * FIRINGS
        _begin_tile(s, beam, firing, azimuths, elevations, until)
        for i in range(offsets[tile], offsets[tile + 1]):
            if (i - offsets[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and _ended(s):
                break
            shape, value = shapes[ranks[i]], values[ranks[i]]
            begin, end = _beams(
                shape, centers[row, column], half_widths[row, column], beam_lows[row, column], beam_highs[row, column]
            )
            _weigh(s, begin, end, shape)
            for k in range(channels):
                _add(s, begin, end, RANGE_SUM + 1 + k, WEIGHT, value[k])
        for i in range(beam, min(beam + BEAMS, beams)):
            for j in range(firing, min(firing + FIRINGS, firings)):
                p = (i - beam) * FIRINGS + j - firing
                range_sum[i, j], alpha[i, j] = s[RANGE_SUM * RAYS + p], s[ALPHA * RAYS + p]
                before[i, j], median[i, j] = s[BEFORE * RAYS + p], s[MEDIAN * RAYS + p]
                for k in range(channels):
                    out[i, j, k] = s[(RANGE_SUM + 1 + k) * RAYS + p]


@callee
@no_type_check
def _begin_gradients(s, beam, firing, range_sum, alpha, before, out, v_range_sum, v_alpha, v_before, v_out):
    """Loads the gradients of a tile's rays, and the initial REST of each."""
    beams, firings, channels = out.shape
    for i in range(beam, min(beam + BEAMS, beams)):
        for j in range(firing, min(firing + FIRINGS, firings)):
            p = (i - beam) * FIRINGS + j - firing
            s[ALPHA_GRADIENT * RAYS + p], s[BEFORE_GRADIENT * RAYS + p] = v_alpha[i, j], v_before[i, j]
            s[RANGE_GRADIENT * RAYS + p] = v_range_sum[i, j]
            rest = alpha[i, j] * v_alpha[i, j] + before[i, j] * v_before[i, j] + range_sum[i, j] * v_range_sum[i, j]
            for k in range(channels):
                s[(RANGE_GRADIENT + 1 + k) * RAYS + p] = v_out[i, j, k]
                rest += out[i, j, k] * v_out[i, j, k]
            s[REST * RAYS + p] = rest


@fast_callee
@no_type_check
def _begin_backward(s, begin, end, shape):
    """Writes alpha before it is limited to 0.999 to RAW, and the gradient of the weight, but for values, to VALUE."""
    azimuth, elevation = shape[scan_tiles.AZIMUTH], shape[scan_tiles.ELEVATION]
    a, b, c = shape[scan_tiles.CONIC_AA], shape[scan_tiles.CONIC_AE], shape[scan_tiles.CONIC_EE]
    opacity, center, limit = shape[scan_tiles.OPACITY], shape[scan_tiles.RANGE], shape[scan_tiles.RANGE_LIMIT]
    slope_a, slope_e, zero = shape[scan_tiles.SLOPE_A], shape[scan_tiles.SLOPE_E], s.dtype.type(0.0)
    for p in range(begin, end):
        da, de = _around(s[_at(X) + p] - azimuth), s[_at(Y) + p] - elevation
        s[_at(RAW) + p] = gaussian_alpha(da, de, a, b, c, opacity)
        distance = center + _limited(_correction(da, de, slope_a, slope_e), limit)
        in_front = s[_at(BEFORE_GRADIENT) + p] if distance < s[_at(UNTIL) + p] else zero
        s[_at(VALUE) + p] = s[_at(ALPHA_GRADIENT) + p] + in_front + distance * s[_at(RANGE_GRADIENT) + p]


@fast_callee
@no_type_check
def _moments(s, begin, end, shape, out):
    """Advances transmittance and REST, and writes weights and the sums over rays that `MOMENTS` names."""
    real = s.dtype.type
    azimuth, elevation = shape[scan_tiles.AZIMUTH], shape[scan_tiles.ELEVATION]
    slope_a, slope_e, limit = shape[scan_tiles.SLOPE_A], shape[scan_tiles.SLOPE_E], shape[scan_tiles.RANGE_LIMIT]
    zero, one = real(0.0), real(1.0)
    max_alpha, min_transmittance = real(MAX_ALPHA), real(MIN_TRANSMITTANCE)
    m = m_a = m_e = m_aa = m_ae = m_ee = d = f = f_a = f_e = zero
    for p in range(begin, end):
        da, de = _around(s[_at(X) + p] - azimuth), s[_at(Y) + p] - elevation
        raw, before, value = s[_at(RAW) + p], s[_at(TRANSMITTANCE) + p], s[_at(VALUE) + p]
        alpha = raw if raw < max_alpha else max_alpha
        after = before * (one - alpha)
        continues = after > min_transmittance
        weight = alpha * before if continues else zero
        rest = s[_at(REST) + p] - weight * value
        s[_at(REST) + p] = rest
        s[_at(WEIGHT) + p] = weight
        s[_at(TRANSMITTANCE) + p] = after if continues else zero
        v = raw * (before * value - rest / (one - alpha))
        v = v if continues & (raw <= max_alpha) else zero
        m += v
        m_a, m_e = m_a + v * da, m_e + v * de
        m_aa, m_ae, m_ee = m_aa + v * da * da, m_ae + v * da * de, m_ee + v * de * de
        of_range = weight * s[_at(RANGE_GRADIENT) + p]
        free = of_range if abs(_correction(da, de, slope_a, slope_e)) <= limit else zero
        d += of_range
        f, f_a, f_e = f + free, f_a + free * da, f_e + free * de
    out[0], out[1], out[2], out[3], out[4], out[5] = m, m_a, m_e, m_aa, m_ae, m_ee
    out[6], out[7], out[8], out[9] = d, f, f_a, f_e


@fast_callee
@no_type_check
def _weighted_sum(s, begin, end, plane):
    """The sum of a plane times the weights."""
    total = s.dtype.type(0.0)
    for p in range(begin, end):
        total += s[_at(WEIGHT) + p] * s[_at(plane) + p]
    return total


@kernel
@no_type_check
def composite_rays_backward(
    start, stop, first, offsets, ranks, slots, shapes, values, centers, half_widths, beam_lows, beam_highs,
    azimuths, elevations, until, range_sum, alpha, before, out, v_range_sum, v_alpha, v_before, v_out, sums,
):  # fmt: skip
    """Writes each list entry's share of its Gaussian's gradients to its row of `sums`: moments and channels. Rows of
    Gaussians behind the ends of all rays stay as is."""
    channels, columns = out.shape[2], centers.shape[1]
    s = np.empty((RANGE_GRADIENT + 1 + channels) * RAYS, out.dtype)
    for tile in range(start, stop):
        row, column = (first + tile) // columns, (first + tile) % columns
        beam, firing = row * BEAMS, column * FIRINGS
        _begin_tile(s, beam, firing, azimuths, elevations, until)
        _begin_gradients(s, beam, firing, range_sum, alpha, before, out, v_range_sum, v_alpha, v_before, v_out)
        for i in range(offsets[tile], offsets[tile + 1]):
            if (i - offsets[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and _ended(s):
                break
            shape, value, target = shapes[ranks[i]], values[ranks[i]], sums[slots[i]]
            begin, end = _beams(
                shape, centers[row, column], half_widths[row, column], beam_lows[row, column], beam_highs[row, column]
            )
            _begin_backward(s, begin, end, shape)
            for k in range(channels):
                _add(s, begin, end, VALUE, RANGE_GRADIENT + 1 + k, value[k])
            _moments(s, begin, end, shape, target)
            for k in range(channels):
                target[MOMENTS + k] = _weighted_sum(s, begin, end, RANGE_GRADIENT + 1 + k)
