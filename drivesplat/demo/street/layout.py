"""Dimensions of the street's cross-section, in metres."""

LANE, ROAD, CURB, SIDEWALK = 3.5, 6.4, 6.65, 10.0
"""Distances of outer edges from the centre line."""
PARKING, FURNITURE, WALKWAY, TREES, WALL_SIDE = 5.3, 6.95, 7.55, (8.2, 9.0), 9.7
"""Distances from the centre line: of parked vehicles, of lamps, signs and bins, of pedestrians, of trees (nearest and
farthest), of people who stand by the houses."""
CROSSING = (46.0, 49.0)
"""First and last s of the pedestrian crossing."""
WINDOW = (3.2, 3.0)
"""Width and height of the cells of a facade, one window each."""
