"""CUDA C++ kernels, which torch compiles with NVRTC when they are first used."""
