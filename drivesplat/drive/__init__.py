"""A trained drive in Python: opened from its result folder, rendered from any pose, changed object by object.

docs/python.md is its guide. `drivesplat.open`, `drivesplat.Camera`, `drivesplat.TrainedDrive` and
`drivesplat.render_poses` are its names.
"""
