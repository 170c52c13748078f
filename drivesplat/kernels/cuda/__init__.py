"""CUDA C++ kernels, which torch compiles with NVRTC when they are first used. Lists of tiles come from `triton`, which
imports nothing from here."""
