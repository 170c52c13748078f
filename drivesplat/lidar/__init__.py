"""LiDAR sweeps as rays and points."""
