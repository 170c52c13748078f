"""The model: parts and their Gaussians, sky, exposure, checkpoint; its images and LiDAR scans at a time.

Losses of images, optimizers and densification are in `training`.
"""
