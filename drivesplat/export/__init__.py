"""Trained models and recorded cameras as files of other programs, by format: PLY, SPZ and SOG, USD, viewer page, scenes
for AlpaSim; and cameras for COLMAP and nerfstudio."""
