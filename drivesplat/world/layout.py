"""Dimensions of the street's cross-section, in metres."""

LANE, ROAD, CURB, SIDEWALK = 3.5, 6.4, 6.65, 10.0
"""Distances of outer edges from the centre line."""
CYCLE_LANE, ROADSIDE, PARKING = 3.1, 3.7, 5.3
"""Distances from the centre line of cyclists, of pedestrians beside parked vehicles, and of these."""
FURNITURE, SIDEWALK_PATH, TREES, WALL_SIDE = 6.95, 7.55, (8.2, 8.8), 9.4
"""Distances from the centre line of lamps, signs and bins, of pedestrians, of trees (nearest and farthest), and of
people who stand by the houses."""
CROSSING = (46.0, 49.0)
"""First and last s of the pedestrian crossing."""
WINDOW = (3.2, 3.0)
"""Width and height of the cells of a facade, one window each."""
