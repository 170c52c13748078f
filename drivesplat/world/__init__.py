"""Synthetic worlds: streets, recorded by cameras and LiDARs in nuScenes format, with ground truth.

It imports no model and no training. Files are read as those of any dataset, by `readers`.
"""
