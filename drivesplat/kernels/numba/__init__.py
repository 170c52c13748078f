"""Kernels for the CPU, compiled by numba; imported only where a CPU computes."""
