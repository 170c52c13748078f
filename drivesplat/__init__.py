"""drivesplat: turns recorded drives into 3D Gaussian splats and measures them.

Importing the package is fast: modules that need torch, gsplat or nuscenes-devkit are imported by name.
"""
