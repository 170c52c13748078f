"""Compiles gsplat's kernels as the module `csrc` into a folder: `python -m drivesplat.machine.gsplat_build.compile_job
FOLDER`.

A process of its own: torch reads CUDA_HOME, TORCH_CUDA_ARCH_LIST and MAX_JOBS once, and ninja writes to its output.
"""

import sys
from pathlib import Path

from drivesplat.machine.gsplat_build.installed import package_folder


def sources(package: Path) -> list[str]:
    """gsplat's kernels and their Python bindings."""
    cuda = package / "cuda"
    return [str(path) for path in (*sorted(cuda.glob("csrc/*.cu")), *sorted(cuda.glob("csrc/*.cpp")), cuda / "ext.cpp")]


def main(folder: str) -> None:
    """Compiles and imports. The flags are those of gsplat's own build."""
    from torch.utils.cpp_extension import load

    package = package_folder()
    load(
        name="csrc",
        sources=sources(package),
        extra_cflags=["-O3", "-Wno-attributes"],
        extra_cuda_cflags=["-O3", "-use_fast_math"],
        extra_include_paths=[str(package / "cuda/include"), str(package / "cuda/csrc/third_party/glm")],
        build_directory=folder,
        verbose=True,
    )


if __name__ == "__main__":
    main(sys.argv[1])
