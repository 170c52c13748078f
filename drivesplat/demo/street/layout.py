"""Dimensions of the street's cross-section, in metres."""

LANE, ROAD, CURB, SIDEWALK = 3.5, 5.9, 6.15, 9.5
"""Distances of outer edges from the centre line."""
CROSSING = (46.0, 49.0)
"""First and last s of the pedestrian crossing."""
WINDOW = (3.2, 3.0)
"""Width and height of the cells of a facade, one window each."""
