"""Compiled for the CPU: what a GPU does by kernels of torch or gsplat. Imported where a CPU works: it needs numba."""
