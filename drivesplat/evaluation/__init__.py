"""Metrics of trained models on held-out images and LiDAR scans, comparison of methods, and metrics.json.

Pictures are in `inspection`, the report across scenes is in `report`.
"""
