"""Constants of the real spherical harmonics, as 3D Gaussian Splatting orders them (Kerbl et al. 2023)."""

SH_C0 = 0.28209479177387814
"""The constant of the spherical harmonic of degree 0: 1 / (2 sqrt(pi))."""
