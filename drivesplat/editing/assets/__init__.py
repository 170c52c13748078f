"""Actors as assets: files of their Gaussians that other drives and other programs use, the completion of sides that no
camera saw, and the parts of a model that inserted assets are."""
