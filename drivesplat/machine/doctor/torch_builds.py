"""Which builds of torch an NVIDIA GPU and its driver can run; set-up asks before anything is installed.

`python -m drivesplat.machine.doctor.torch_builds BUILD` has the exit status 0 if the build fits, 1 if it does not
(it prints which does), 2 if it is unknown.

torch 2.11 comes for CUDA 13.0 (the wheel on PyPI), 12.8, 12.6 and for the CPU. Sources of the requirements: PyTorch's
release matrix (pytorch/pytorch, RELEASE.md) and NVIDIA's table of minimum drivers ("CUDA Compatibility", minor version
compatibility).
"""

import argparse
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivesplat.machine.compute_capability import MIN_CAPABILITY, Capability, dotted

DEFAULT = "cu130"
QUERY = ("name", "driver_version", "memory.total", "memory.free", "compute_cap")


@dataclass(frozen=True)
class TorchBuild:
    """A build of torch and its requirements."""

    name: str
    cuda: str
    min_driver: str
    min_capability: Capability
    max_capability: Capability


BUILDS = {
    "cu130": TorchBuild("cu130", "13.0", "580", (7, 5), (12, 1)),
    "cu128": TorchBuild("cu128", "12.8", "525.60.13", (7, 5), (12, 1)),
    "cu126": TorchBuild("cu126", "12.6", "525.60.13", (5, 0), (8, 9)),
}
"""In order of preference. Some releases of cu126 list Hopper, too; cu128 always supports it."""
CPU = "cpu"
GENERATIONS = (
    ((5, 0), "older than Maxwell"), ((6, 0), "Maxwell"), ((7, 0), "Pascal"), ((7, 5), "Volta"), ((8, 0), "Turing"),
    ((8, 9), "Ampere"), ((9, 0), "Ada"), ((10, 0), "Hopper"),
)  # fmt: skip


@dataclass(frozen=True)
class Gpu:
    """A GPU as reported by nvidia-smi; None where it reports no value."""

    name: str
    driver: str
    capability: Capability | None = None
    total_gb: float | None = None
    free_gb: float | None = None

    def __str__(self) -> str:
        if self.capability is None:
            return f"{self.name} (driver {self.driver})"
        return f"{self.name} ({generation(self.capability)}, compute capability {dotted(self.capability)})"

    @property
    def runs_gsplat(self) -> bool:
        """Whether gsplat can run on it, as far as is known."""
        return self.capability is None or self.capability >= MIN_CAPABILITY


def generation(capability: Capability) -> str:
    """The name of a GPU's architecture."""
    return next((name for end, name in GENERATIONS if capability < end), "Blackwell")


def read_gpus(run: Callable[..., subprocess.CompletedProcess] = subprocess.run) -> tuple[list[Gpu], str | None]:
    """The NVIDIA GPUs, and the problem with nvidia-smi; None if there is none, or no nvidia-smi."""
    for fields in (QUERY, QUERY[:-1]):  # nvidia-smi of drivers before 510 does not know compute_cap
        command = ["nvidia-smi", f"--query-gpu={','.join(fields)}", "--format=csv,noheader,nounits"]
        try:
            done = run(command, capture_output=True, text=True, check=False, timeout=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            return [], None if isinstance(error, FileNotFoundError) else f"nvidia-smi does not answer ({error})"
        if done.returncode == 0:
            gpus = []
            for line in done.stdout.splitlines():
                if line.count(",") >= len(fields) - 1:
                    name, driver, *memory, capability = (part.strip() for part in [*line.split(","), ""][:5])
                    total, free = (int(mb) * 2**20 / 1e9 if mb.isdigit() else None for mb in memory)
                    match = re.fullmatch(r"(\d+)\.(\d+)", capability)
                    gpus.append(Gpu(name, driver, (int(match[1]), int(match[2])) if match else None, total, free))
            return gpus, None if gpus else "nvidia-smi reports no GPU"
    return [], f"nvidia-smi fails: {' '.join((done.stdout + ' ' + done.stderr).split()) or 'no message'}"


def at_least(version: str, other: str) -> bool:
    """Whether a driver version is `other` or later."""
    return [int(n) for n in re.findall(r"\d+", version)] >= [int(n) for n in re.findall(r"\d+", other)]


def incompatibility(gpu: Gpu, build: TorchBuild) -> str | None:
    """Why a GPU cannot run a build of torch; None if it can, as far as is known."""
    low, high = build.min_capability, build.max_capability
    if gpu.capability is not None and not low <= gpu.capability <= high:
        return f"torch for CUDA {build.cuda} covers compute capabilities {dotted(low)} to {dotted(high)}"
    if not at_least(gpu.driver, build.min_driver):
        return f"torch for CUDA {build.cuda} needs driver {build.min_driver} or newer"
    return None


def best_build(gpu: Gpu) -> str | None:
    """The best build of torch for a GPU that gsplat supports; None if there is none."""
    fits = [name for name, build in BUILDS.items() if gpu.runs_gsplat and incompatibility(gpu, build) is None]
    if fits and fits[0] != DEFAULT and "cu126" in fits:
        return "cu126"  # PyTorch's long-term build for older drivers and GPUs
    return fits[0] if fits else None


def advice(gpus: Sequence[Gpu], build_name: str) -> str | None:
    """Why none of the GPUs can run a build of torch, with what to do; None if one of them can."""
    if build_name == CPU or not gpus:
        return None
    build = BUILDS[build_name]
    usable = [gpu for gpu in gpus if gpu.runs_gsplat]
    if not usable:
        return (
            f"{gpus[0]} is too old for gsplat, which needs compute capability 7.0 (Volta) or newer; no build of torch "
            "changes that. The CPU demo runs: TORCH_CUDA=cpu make setup"
        )
    if any(incompatibility(gpu, build) is None for gpu in usable):
        return None
    gpu = max(usable, key=lambda gpu: gpu.capability or (0, 0))
    better = best_build(gpu)
    found = f"{gpu} has driver {gpu.driver}" if gpu.capability else f"the GPU is {gpu}"
    problem = f"{found}, but {incompatibility(gpu, build)}"
    update = f"update NVIDIA's driver to {BUILDS[DEFAULT].min_driver} or newer"
    if better is None:
        return f"{problem}: {update}, or install for the CPU: TORCH_CUDA=cpu make setup"
    take = f"install the build for CUDA {BUILDS[better].cuda}: TORCH_CUDA={better} make setup"
    if better != DEFAULT and (gpu.capability is None or gpu.capability >= BUILDS[DEFAULT].min_capability):
        take = f"{update} (best), or {take}"
    return f"{problem}: {take}"


def main(arguments: Sequence[str]) -> int:
    """Prints why a build does not fit the GPUs of this machine. Returns the exit status."""
    parser = argparse.ArgumentParser("python -m drivesplat.machine.doctor.torch_builds", description=__doc__)
    parser.add_argument("build", nargs="?", default=DEFAULT, help=f"{', '.join([*BUILDS, CPU])}; default {DEFAULT}")
    name = parser.parse_args(arguments).build
    if name != CPU and name not in BUILDS:
        print(f"setup: TORCH_CUDA={name} is unknown; known builds: {', '.join([*BUILDS, CPU])}", file=sys.stderr)
        return 2
    gpus, problem = read_gpus()
    if problem and name != CPU:
        print(f"setup: NVIDIA GPUs cannot be queried: {problem}", file=sys.stderr)
    sentence = advice(gpus, name)
    if sentence:
        print(f"setup: {sentence}", file=sys.stderr)
    return 1 if sentence else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
