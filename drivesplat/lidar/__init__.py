"""LiDAR sweeps and scans: rays, points, ground, occlusion, colours, records of depth and free space.

It reads sweeps by `readers`, and imports no model. Moving objects found in scans are in `objects`.
"""
