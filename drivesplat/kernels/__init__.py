"""Operations on tensors. Each has one module, whose function selects the kernel by the device of its tensors: CUDA C++,
Triton or gsplat on GPUs, numba on CPUs, or torch. Only this package imports the packages `triton` and `numba`.

It knows no scene, no model and no settings, and imports `errors`, `io` and `provenance` alone.
"""
