"""Edits of a trained drive: films, rendered drive folders, LiDAR scans, and samples for viewers.

The change of motion by an edit is in `trajectories`.
"""
