"""Poses of a recorded drive, corrected by what its images show, or made from these.

Frames as in `drivesplat.scene.scene`. A correction is a rigid transform in the own car's frame: refined ego_to_world =
given ego_to_world @ correction. What is wrong with recorded poses (no height, roll and pitch off by half a degree)
belongs to the car and changes slowly, so corrections carry over to the times between images.
"""
