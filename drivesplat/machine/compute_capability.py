"""CUDA compute capabilities, as GPUs have them and as gsplat's kernels are compiled for. Standard library only."""

import re
from collections.abc import Iterable

Capability = tuple[int, int]
MIN_CAPABILITY: Capability = (7, 0)
"""gsplat's kernels use `labeled_partition` of cooperative groups, which GPUs before Volta lack (issue 401 of
nerfstudio-project/gsplat)."""


def dotted(capability: Capability) -> str:
    """A compute capability in NVIDIA's notation, such as "8.6"."""
    return f"{capability[0]}.{capability[1]}"


def parse_arch(arch: str) -> tuple[Capability, bool] | None:
    """The compute capability of an entry of TORCH_CUDA_ARCH_LIST ("8.6", "9.0a", "8.6+PTX") and whether it includes
    PTX; None if it is malformed."""
    match = re.fullmatch(r"(\d+)\.(\d)a?(\+PTX)?", arch)
    return ((int(match[1]), int(match[2])), match[3] is not None) if match else None


def covers(archs: Iterable[str], capability: Capability) -> bool:
    """Whether code for `archs` runs on a GPU of this compute capability.

    Machine code runs on its own and later minor versions of one major version; PTX on all later versions.
    CUDA C++ Programming Guide, "Binary compatibility" and "PTX compatibility".
    """
    for arch, has_ptx in filter(None, map(parse_arch, archs)):
        if (capability[0] == arch[0] and capability[1] >= arch[1]) or (has_ptx and capability >= arch):
            return True
    return False
