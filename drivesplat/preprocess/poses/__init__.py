"""Camera and ego poses refined with the images of a drive, or estimated from them.

Frames as in `drivesplat.scene.scene`. A correction is a rigid transform in the ego frame: refined ego_to_world = given
ego_to_world @ correction. The errors of recorded poses (no height, roll and pitch off by half a degree) are those of
the vehicle and change slowly, so corrections are interpolated between images.
"""
