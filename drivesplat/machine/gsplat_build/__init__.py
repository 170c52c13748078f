"""gsplat's CUDA kernels, compiled once at set-up and kept inside the installed gsplat package.

gsplat's wheel on PyPI holds sources. Left alone it compiles them at its first import, for minutes, and only where nvcc
is at hand at that moment. Compiled here they become the module `gsplat.csrc`, which gsplat's loader tries before
anything else: later imports need neither nvcc nor any variable. `python -m drivesplat.machine.gsplat_build` does it,
and `make setup`.
"""
