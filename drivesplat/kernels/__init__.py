"""Compiled kernels: Triton on GPUs, numba on CPUs."""
