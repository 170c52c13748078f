"""gsplat's CUDA kernels, compiled once at set-up and stored inside the installed gsplat package.

gsplat's wheel on PyPI contains sources. By default gsplat compiles them at its first import, which takes minutes and
needs nvcc at that moment. Compiled here they become the module `gsplat.csrc`, which gsplat's loader tries first, so
that later imports need neither nvcc nor environment variables. `make setup` calls
`python -m drivesplat.machine.gsplat_build`.
"""
