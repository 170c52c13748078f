"""Meshes and limb motion of the objects of a synthetic world. Where they stand is in `street`."""
