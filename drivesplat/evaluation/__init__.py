"""Metrics of trained models on held-out images and LiDAR scans, comparison of methods, and metrics.json.

Pictures are in `visuals`, the report across scenes is in `report`.
"""
