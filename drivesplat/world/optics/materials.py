"""Procedural textures, compiled: colour, mirror reflectance and emission of a surface as functions of position.

Textures are filtered by the size of a pixel on the surface (`footprint`, metres): details below it fade to their mean,
do not flicker, and are not computed.
"""

import math
from typing import no_type_check

from drivesplat.world.layout import CROSSING, CURB, LANE, ROAD, SIDEWALK, WINDOW
from drivesplat.world.optics.patterns import (
    compiled,
    coverage,
    fractal,
    glyphs,
    grain,
    hash_noise,
    plane_fractal,
    plane_noise,
    stripes,
    tiles,
    visible,
)  # fmt: skip
from drivesplat.world.shapes.mesh import BARK, Material

BARE_ASPHALT = -10.0
"""Where the texture of the ground is lower than this, it is road without paint."""
PLAIN, ROAD_, FACADE, LEAVES, PAINT, GLASS, LAMP, CLOTH, STRIPES, METAL, SIGN = (int(m) for m in Material)


@compiled
@no_type_check
def ground(x, y, footprint):
    """Linear reflectance of road, markings, curb, sidewalk and grass."""
    a = abs(y)
    if a > SIDEWALK:
        tone = 1 + 0.7 * plane_fractal(x, y, 3.0, footprint) + 0.5 * grain(x, y, 0.15, footprint)
        tone += 0.6 * grain(x, 0.5 * y, 0.025, footprint)
        return 0.11 * max(0.1, tone), 0.17 * max(0.15, tone), 0.05 * max(0.1, tone)
    if a > CURB:
        size, joint = (0.12, 0.012) if a < CURB + 0.48 else (0.45, 0.01)
        gaps, slab = tiles(x, y, size, size, joint, footprint)
        tone = 0.3 * (1 + 0.3 * slab + 0.2 * plane_fractal(x, y, 1.5, footprint))
        tone *= (1 - 0.6 * gaps) * (1 + 0.12 * grain(x, y, 0.02, footprint))
        return tone, 0.97 * tone, 0.92 * tone
    if a > ROAD:
        tone = 0.36 * (1 + 0.2 * plane_fractal(x, y, 1.0, footprint)) * (1 + 0.25 * grain(x, y, 0.015, footprint))
        tone *= 1 - 0.6 * stripes(x, 1.0, 0.012, footprint)
        return tone, tone, 0.98 * tone
    tone = 0.085 * asphalt(x, y, footprint) * iron(x, y, footprint)
    white = paint(x, y, footprint)
    if white > 0.0:
        white *= 0.75 + 0.25 * plane_fractal(x, y, 0.6, footprint) + 0.1 * grain(x, y, 0.012, footprint)
        white *= 1 - 0.5 * max(0.0, 1.5 * grain(x, y, 0.07, footprint) - 0.6)
    tone = tone * (1 - white) + 0.6 * white
    return tone, tone, 1.03 * tone


@compiled
@no_type_check
def paint(x, y, footprint):
    """Share of a pixel on the road that is painted: lane edges, the dashed centre line, the crossing."""
    a = abs(y)
    white = coverage(a, LANE - 0.08, LANE + 0.08, footprint)
    if a < 0.08 + footprint:
        white = max(white, coverage(a, -0.08, 0.08, footprint) * stripes(x, 6.0, 3.0, footprint))
    if CROSSING[0] - 1 < x < CROSSING[1] + 1:
        white = max(white, coverage(x, CROSSING[0], CROSSING[1], footprint) * stripes(y, 1.0, 0.5, footprint))
    return white


@compiled
@no_type_check
def asphalt(x, y, footprint):
    """Tone of asphalt around 1: stains, repaired patches, seams of tar, cracks, stones."""
    tone = 1 + 0.5 * plane_fractal(x, y, 3.0, footprint) + 0.5 * plane_fractal(x, y, 0.5, footprint)
    cell = math.floor(x / 11.0)
    at, side, seam = x - 11.0 * cell - 6.0 * hash_noise(cell, 1, 11), y - 5.0 * hash_noise(cell, 2, 11) + 3.5, 0.0
    if hash_noise(cell, 0, 11) < 0.5:  # a repaired patch and the tar along its edges
        outer = coverage(at, 0.0, 2.5, footprint) * coverage(side, 0.0, 1.7, footprint)
        inner = coverage(at, 0.05, 2.45, footprint) * coverage(side, 0.05, 1.65, footprint)
        tone *= 1 - 0.4 * inner
        seam = outer - inner
    if footprint < 0.2:
        seam = max(seam, coverage(abs(y - 0.5) + 0.08 * plane_noise(0.7 * x, 0.0, 12), 1.34, 1.4, footprint))
        if footprint < 0.05 and seam == 0.0:
            field = plane_noise(0.45 * x, 0.6 * y, 20) + 0.1 * plane_noise(5 * x, 5 * y, 21) - 0.55
            tone *= 1 - 0.75 * visible(0.05, footprint) * coverage(field, -0.003, 0.003, 0.7 * footprint + 0.002)
        tone *= 1 + 0.55 * grain(x, y, 0.014, footprint) + 0.2 * grain(y, x, 0.05, footprint)
    return max(0.1, tone) * (1 - 0.65 * seam)


@compiled
@no_type_check
def iron(x, y, footprint):
    """Tone around 1 of the cover of a manhole; 1 on bare asphalt."""
    cell = math.floor(x / 13.0)
    u, v = x - 13.0 * cell - 2.0 - 9.0 * hash_noise(cell, 3, 11), y - 2.2 + 4.4 * hash_noise(cell, 4, 11)
    if footprint > 0.3 or max(abs(u), abs(v)) > 0.4 + footprint:
        return 1.0
    radius, ribs = math.hypot(u, v), stripes(u + v, 0.08, 0.04, footprint) * stripes(u - v, 0.08, 0.06, footprint)
    lid, rim = coverage(radius, -1.0, 0.29, footprint), coverage(radius, 0.31, 0.36, footprint)
    return 1 + lid * (0.9 * ribs - 0.3) + 0.35 * rim - 0.8 * coverage(radius, 0.29, 0.31, footprint)


@compiled
@no_type_check
def masonry(style, along, z, footprint):
    """Bricks (style 0), plaster (1) or slabs (2): tone around 1, fraction of joints and their reflectance."""
    tone = 1 + 0.3 * plane_fractal(along, z, 2.0, footprint)
    if style == 1:
        tone += 0.12 * plane_fractal(along, 0.1 * z, 0.3, footprint) + 0.1 * grain(along, z, 0.02, footprint)
        return tone, coverage(z % WINDOW[1], 2.75, 2.95, footprint), 0.5  # a cornice on every floor
    width, height, joint, mortar = (0.25, 0.075, 0.011, 0.36) if style == 0 else (1.6, 0.75, 0.02, 0.06)
    gaps, tile = tiles(along, z, width, height, joint, footprint)
    return tone + (0.6 if style == 0 else 0.15) * tile + 0.08 * grain(along, z, 0.02, footprint), gaps, mortar


@compiled
@no_type_check
def interior(u, v, column, floor, footprint):
    """Reflectance r, g, b behind a pane at u, v metres in its cell: goods in shops, curtains and blinds above."""
    if footprint > 0.3:
        return (0.115, 0.106, 0.106) if floor == 0 else (0.213, 0.213, 0.224)
    if floor > 0:
        blind = coverage(v, 2.5 - 1.2 * hash_noise(column, floor, 15), 3.0, footprint)
        side = coverage(abs(u - 1.6), 0.75 - 0.5 * hash_noise(column, floor, 16), 1.6, footprint)
        light = max(blind * stripes(v, 0.05, 0.042, footprint), side * stripes(u, 0.09, 0.075, footprint))
        tone = 0.03 + 0.1 * hash_noise(column, floor, 5) + 0.3 * light
        return tone, tone, 1.05 * tone
    shelf = 0.0 if v < 1.5 else 1.5
    place = math.floor(u / 0.31) + 11 * column
    size = 0.3 + 0.75 * hash_noise(place, int(shelf), 31)
    item = coverage(v - shelf, 0.4 if v < 1.5 else 0.0, size, footprint)
    item *= coverage(abs(u % 0.31 - 0.155), -1.0, 0.11 if v - shelf < 0.7 * size else 0.05, footprint)
    back, shade = (1 - item) * (0.07 + 0.1 * coverage(v, 1.44, 1.5, footprint)), 0.1 * item
    red, green, blue = hash_noise(place, 1, 32), hash_noise(place, 2, 32), hash_noise(place, 3, 32)
    return back + shade * (1 + 4 * red**2), back + shade * (1 + 3 * green**2), back + shade * (1 + 3 * blue**2)


@compiled
@no_type_check
def facade(r, g, b, along, z, footprint):
    """A wall with windows, shops on the ground floor: reflectance r, g, b, mirror reflectance, emission at night."""
    column, floor = math.floor(along / WINDOW[0]), math.floor(z / WINDOW[1])
    u, v, shop = along - WINDOW[0] * column, z - WINDOW[1] * floor, floor == 0
    style = math.floor(3 * hash_noise(1000 * r, 1000 * g, 1000 * b))
    tone, gaps, mortar = masonry(style, along, z, footprint)
    brick = tone * (1 - gaps)
    r, g, b = r * brick + mortar * gaps, g * brick + mortar * gaps, b * brick + mortar * gaps
    edge, sill, top = (0.25, 0.4, 2.4) if shop else (0.8 + 0.15 * style, 0.9, 2.3 + 0.1 * style)
    width, bars = WINDOW[0] - 2 * edge, 0.0
    frame = stripes(along - edge + 0.07, WINDOW[0], width + 0.14, footprint)
    frame *= coverage(v, sill - 0.07, top + 0.07, footprint)
    pane = stripes(along - edge, WINDOW[0], width, footprint) * coverage(v, sill, top, footprint)
    pane *= 1 - coverage(u, 1.57, 1.63, footprint)
    if shop:  # a sign above
        board = coverage(v, 2.5, 2.92, footprint) * coverage(u, 0.15, WINDOW[0] - 0.15, footprint)
        ink = 0.6 * coverage(v, 2.6, 2.82, footprint) * glyphs(u, v - 2.6, 0.22, column, footprint)
        r += board * (0.5 * hash_noise(column, 1, 9) ** 2 + ink - r)
        g += board * (0.5 * hash_noise(column, 2, 9) ** 2 + ink - g)
        b += board * (0.5 * hash_noise(column, 3, 9) ** 2 + ink - b)
    elif footprint < 0.3 and hash_noise(column, style, 8) < 0.3:  # the railing of a balcony
        bars = coverage(u, edge - 0.2, WINDOW[0] - edge + 0.2, footprint) * coverage(v, 0.05, 1.0, footprint)
        bars *= visible(0.3, footprint) * max(stripes(along, 0.11, 0.022, footprint), coverage(v, 0.94, 1.0, footprint))
    red, green, blue = interior(u, v, column, floor, footprint) if pane > 0.0 else (0.0, 0.0, 0.0)
    trim, left = 0.55 * (frame - pane), 1 - bars
    lit = 1.0 if shop else 0.3 + visible(2.0, footprint) * (0.7 if hash_noise(column, floor, 6) < 0.3 else -0.3)
    r = left * (r * (1 - frame) + trim + red * pane)
    g = left * (g * (1 - frame) + trim + green * pane)
    b = left * (b * (1 - frame) + 0.9 * trim + blue * pane)
    return r, g, b, left * pane, 0.5 * left * pane * lit


@compiled
@no_type_check
def lettering(r, g, b, along, z, footprint):
    """A panel with lines of letters about z = 0 and a picture above and below: as `facade`."""
    line, dark = math.floor((z + 0.15) / 0.3), 0.7 if r + g + b < 0.9 else 0.04
    picture = min(1.0, max(0.0, 0.5 + 1.5 * grain(along, z, 0.5, footprint)))
    ink = stripes(z + 0.07, 0.3, 0.14, footprint) * glyphs(along, z - 0.3 * line + 0.07, 0.14, line + 50, footprint)
    ink = picture + coverage(z, -0.45, 0.45, footprint) * (ink - picture)
    return r + ink * (dark - r), g + ink * (dark - g), b + ink * (dark - b), 0.0, 0.0


@compiled
@no_type_check
def surface(material, r, g, b, x, y, z, nx, ny, nz, footprint):
    """Reflectance r, g, b, mirror reflectance and emission at night of a point with normal n in the object's frame."""
    if material == ROAD_:
        if z < BARE_ASPHALT:
            r = 0.085 * asphalt(x, y, footprint) * iron(x, y, footprint)
            return r, r, 1.03 * r, 0.0, 0.0
        r, g, b = ground(x, y, footprint)
        return r, g, b, 0.0, 0.0
    along = y if abs(nx) > abs(ny) else x
    if material == FACADE:
        return facade(r, g, b, along, z, footprint)
    if material == SIGN:
        return lettering(r, g, b, along, z, footprint)
    tone, mirror, emission = 1.0, 1.0 if material in (PAINT, GLASS) else 0.0, 0.0
    if material == LEAVES:
        cell = hash_noise(math.floor((x + z) / 0.06), math.floor((y - z) / 0.06), math.floor((x - y) / 0.06))
        tone = max(0.15, 1 + 1.1 * fractal(x, y, z, 0.9, footprint) + visible(0.07, footprint) * (cell - 0.5))
    elif material == PAINT and abs(ny) > 0.6:  # the seams of doors
        for at in (-0.95, 0.0, 0.85):
            tone = min(tone, 1 - 0.7 * coverage(x, at - 0.006, at + 0.006, footprint))
    elif material == LAMP:
        mirror, emission = 0.3, 1.5
    elif material == METAL:
        mirror, tone = 0.5, 1 + 0.15 * grain(along, 9 * z, 0.2, footprint)
    elif material == CLOTH:
        tone = 1 + 0.5 * fractal(x, y, z, 0.25, footprint)
    elif material == STRIPES:
        white = coverage(z, 0.25, 0.42, footprint)
        r, g, b = r + white * (0.75 - r), g + white * (0.75 - g), b + white * (0.75 - b)
    elif material == PLAIN:
        tone = 1 + 0.2 * fractal(x, y, z, 0.7, footprint)
        if abs(r - BARK[0]) + abs(b - BARK[2]) < 1e-4:
            tone += 0.8 * grain(along, 0.15 * z + 0.2 * x, 0.03, footprint)
    return r * tone, g * tone, b * tone, mirror, emission
