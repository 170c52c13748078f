"""The layout of arrays that the kernels of the CPU rasterizer share."""

TILE_WIDTH = 16
TILE_HEIGHT = 16
"""Size of a tile in pixels."""
MIN_ALPHA = 1.0 / 255.0
"""Minimum alpha: smaller contributions are not drawn."""
SLACK = 0.02
"""Margin of ellipses in pixels, larger than any float32 rounding error."""
MEAN_X, MEAN_Y, CONIC_XX, CONIC_XY, CONIC_YY, OPACITY, REACH, RADIUS_X, RADIUS_Y = range(9)
"""Columns of `Splats.shapes`. A Gaussian is drawn where its exponent's quadratic form is at most REACH."""
MOMENTS = 6
"""First columns of an entry's gradients: those of the exponent times 1, dx, dy, dx², dx dy and dy². The channels'
follow."""
