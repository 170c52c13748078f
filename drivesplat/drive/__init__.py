"""A trained drive in Python: opened from its result folder, rendered from any pose, changed object by object.

docs/python.md is its guide. Its names are `drivesplat.open`, `Camera`, `Lidar`, `TrainedDrive`,
`LongDrive`, `render_poses` and `LiveServer`.
"""
