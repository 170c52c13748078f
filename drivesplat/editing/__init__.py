"""Edits of a trained drive: films, rendered drive folders, LiDAR scans, and samples for viewers.

What an edit does to motions is in `trajectories`.
"""
