"""Compiles gsplat's kernels for the GPUs of this machine, or for the compute capabilities in GSPLAT_ARCHS.

Does nothing if they are compiled already, without a CUDA build of torch, or without a GPU.
"""

import argparse
import os
import sys
from collections.abc import Mapping, Sequence

from drivesplat.errors import DeviceError, DriveSplatError
from drivesplat.machine.compute_capability import MIN_CAPABILITY, Capability, covers, dotted, parse_arch
from drivesplat.machine.doctor.torch_builds import read_gpus
from drivesplat.machine.gsplat_build import compile as building
from drivesplat.machine.gsplat_build import diagnose
from drivesplat.machine.gsplat_build.installed import build_record, compiled_extension, torch_platform
from drivesplat.machine.gsplat_build.toolkit import provide_toolkit

NONE = "none"
"""GSPLAT_ARCHS=none: do not compile."""


def wanted_archs(environment: Mapping[str, str], capabilities: Sequence[Capability]) -> list[str]:
    """The architectures to compile for: GSPLAT_ARCHS, else those of the GPUs that gsplat supports; "none" is none."""
    archs = environment.get("GSPLAT_ARCHS", "").replace(",", ";").replace(" ", ";").split(";")
    if any(archs):
        return [arch for arch in archs if arch and archs != [NONE]]
    return [dotted(capability) for capability in sorted(set(capabilities)) if capability >= MIN_CAPABILITY]


def is_compiled(archs: Sequence[str]) -> bool:
    """Whether the installed gsplat has kernels for all of `archs`, or came with its own kernels."""
    if compiled_extension() is None:
        return False
    compiled_for = build_record().get("archs")
    if compiled_for is None:
        return True
    parsed = {arch: parse_arch(arch) for arch in archs}
    return all(
        arch in compiled_for or (has_ptx is False and covers(compiled_for, capability))
        for arch, (capability, has_ptx) in parsed.items()
    )


def main(arguments: Sequence[str]) -> int:
    """Compiles if needed. Returns the exit status."""
    parser = argparse.ArgumentParser("python -m drivesplat.machine.gsplat_build", description=__doc__)
    parser.add_argument("--if-needed", action="store_true", help="print nothing if there is nothing to do")
    quiet = parser.parse_args(arguments).if_needed
    try:
        skipped = build(os.environ)
    except DriveSplatError as error:
        report(str(error))
        return 1
    except KeyboardInterrupt:
        report("interrupted; compiled files are kept, and `make setup` continues from there")
        return 130
    if skipped and not quiet:
        report(skipped)
    return 0


def build(environment: Mapping[str, str]) -> str | None:
    """Compiles what is wanted and missing. Returns why nothing is wanted, else None. Raises DeviceError."""
    cuda, hip = torch_platform()
    if not cuda:
        return f"not compiled: this torch is built for {'ROCm, see docs/amd.md' if hip else 'the CPU alone'}"
    gpus, problem = read_gpus()
    archs = wanted_archs(environment, [gpu.capability for gpu in gpus if gpu.capability])
    if not archs:
        found = problem or ("no GPU that gsplat supports" if gpus else "no NVIDIA GPU here")
        return (
            f"not compiled: {found}. The CPU demo needs no GPU; for a GPU elsewhere name its compute capability: "
            'GSPLAT_ARCHS="7.5;8.6;8.9" make setup'
        )
    if problem := diagnose.arch_problem(archs, cuda):
        raise DeviceError(problem)
    if is_compiled(archs):
        return None
    if problem := diagnose.missing_prerequisite():
        raise DeviceError(f"gsplat cannot be compiled: {problem}")
    toolkit = provide_toolkit(cuda)
    given = environment.get("MAX_JOBS", "")
    jobs = int(given) if given.isdigit() else 0
    jobs = jobs or building.parallel_jobs(len(os.sched_getaffinity(0)), building.free_memory_gb())
    report(
        f"compiling for compute capability {', '.join(archs)} with nvcc {toolkit.release} ({toolkit.origin}), "
        f"{jobs} file(s) at a time: about {building.expected_minutes(len(archs), jobs)} min, once; "
        f"log in {building.log_file()}"
    )
    report(f"compiled: {building.compile_and_install(toolkit, archs, jobs, report)}")
    return None


def report(text: str) -> None:
    """Prints lines in the format of the set-up."""
    for line in text.splitlines():
        print(f"gsplat: {line}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
