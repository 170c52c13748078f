"""Operations with kernels for GPUs (Triton, gsplat) and CPUs (numba): one module and function each, which picks its
kernel by the device of its tensors. Their packages `triton` and `numba` are not imported from outside."""
