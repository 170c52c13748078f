"""Measurements of the sensors of a synthetic world: ray casting, light, materials, camera images, LiDAR scans."""
