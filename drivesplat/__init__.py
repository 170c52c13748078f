"""drivesplat: recorded drives into 3D Gaussian splats, and what that is worth, measured.

Importing the package is cheap: modules that need torch, gsplat or nuscenes-devkit are imported by name.
"""
