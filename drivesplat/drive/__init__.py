"""A trained drive in Python: opened from its result folder, rendered from any pose, changed object by object.

docs/python.md is its guide. `drivesplat.open`, `drivesplat.Camera` and `drivesplat.TrainedDrive` are its names.
"""
