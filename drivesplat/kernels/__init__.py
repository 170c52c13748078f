"""Operations with kernels for GPUs (Triton, gsplat) and CPUs (numba). Each has one module, whose function selects the
kernel by the device of its tensors. Only this package imports the packages `triton` and `numba`."""
