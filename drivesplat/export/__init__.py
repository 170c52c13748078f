"""Trained models and recorded cameras as files of other programs, a module per format: PLY, SPZ, SOG, USD, viewer page,
COLMAP, nerfstudio."""
