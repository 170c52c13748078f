"""Clips of NVIDIA NCore V4: Zarr stores, in folders or indexed tar files, with a JSON manifest beside them."""
