"""Operations with kernels for GPUs (CUDA C++, Triton, gsplat) and CPUs (numba). Each has one module, whose function
selects the kernel by the device of its tensors. Only this package imports the packages `triton` and `numba`."""
