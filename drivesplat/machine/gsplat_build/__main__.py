"""`python -m drivesplat.machine.gsplat_build`: compiles gsplat for the cards of this machine, or for those GSPLAT_ARCHS
names.

Does nothing where that has been done, and where there is no CUDA build of torch or no card; with `--if-needed` it does
not even say so.
"""

import os
import sys
from collections.abc import Mapping, Sequence

from drivesplat.errors import DeviceError, DriveSplatError
from drivesplat.machine.doctor.torch_builds import OLDEST_FOR_GSPLAT, Capability, read_cards
from drivesplat.machine.gsplat_build import compile as building
from drivesplat.machine.gsplat_build import diagnose
from drivesplat.machine.gsplat_build.installed import build_record, compiled_extension, covers, torch_platform
from drivesplat.machine.gsplat_build.toolkit import provide_toolkit

NONE = "none"
"""GSPLAT_ARCHS=none: do without gsplat's kernels."""


def wanted_archs(environment: Mapping[str, str], capabilities: Sequence[Capability]) -> list[str]:
    """What to compile for: GSPLAT_ARCHS, else the cards at hand that gsplat can run on; "none" is nothing."""
    given = environment.get("GSPLAT_ARCHS", "").replace(",", ";").replace(" ", ";")
    asked = [arch for arch in given.split(";") if arch]
    if asked:
        return [] if asked == [NONE] else asked
    return [f"{major}.{minor}" for major, minor in sorted(set(capabilities)) if (major, minor) >= OLDEST_FOR_GSPLAT]


def already_done(archs: Sequence[str]) -> bool:
    """Whether the installed gsplat holds code for all of `archs`, or brought its own kernels."""
    if compiled_extension() is None:
        return False
    compiled_for = build_record().get("archs")
    if compiled_for is None:
        return True
    return all(arch in compiled_for or ("+" not in arch and covers(compiled_for, _capability(arch))) for arch in archs)


def _capability(arch: str) -> Capability:
    major, minor = arch.rstrip("a").split(".")
    return int(major), int(minor)


def main(arguments: Sequence[str]) -> int:
    """Compiles where there is need. Returns the exit status."""
    try:
        skipped = build(os.environ)
    except DriveSplatError as error:
        say(str(error))
        return 1
    except KeyboardInterrupt:
        say("interrupted; what has been compiled is kept, `make setup` goes on from there")
        return 130
    if skipped and "--if-needed" not in arguments:
        say(skipped)
    return 0


def build(environment: Mapping[str, str]) -> str | None:
    """Compiles what is wanted and lacking. Returns why nothing is wanted, or None. Raises DeviceError."""
    cuda, hip = torch_platform()
    if not cuda:
        kind = "ROCm: gsplat comes compiled there, see docs/amd.md" if hip else "the CPU alone"
        return f"not compiled: this torch is built for {kind}"
    cards, trouble = read_cards()
    archs = wanted_archs(environment, [card.capability for card in cards if card.capability])
    if not archs:
        found = trouble or ("no card that gsplat can run on" if cards else "no NVIDIA GPU here")
        return (
            f"not compiled: {found}. The CPU demo needs no GPU; for a GPU elsewhere name its compute capability: "
            'GSPLAT_ARCHS="7.5;8.6;8.9" make setup'
        )
    if problem := diagnose.arch_problem(archs, cuda):
        raise DeviceError(problem)
    if already_done(archs):
        return None
    if problem := diagnose.what_is_missing():
        raise DeviceError(f"gsplat cannot be compiled: {problem}")
    toolkit = provide_toolkit(cuda)
    jobs = _jobs(environment)
    say(
        f"compiling for compute capability {', '.join(archs)} with nvcc {toolkit.release} ({toolkit.origin}), "
        f"{jobs} file(s) at a time: about {building.expected_minutes(len(archs), jobs)} min, once; "
        f"log in {building.log_file()}"
    )
    say(f"compiled: {building.compile_and_install(toolkit, archs, jobs, say)}")
    return None


def _jobs(environment: Mapping[str, str]) -> int:
    given = environment.get("MAX_JOBS", "")
    if given.isdigit() and int(given) > 0:
        return int(given)
    return building.parallel_jobs(len(os.sched_getaffinity(0)), building.free_memory_gb())


def say(text: str) -> None:
    """Lines on the console, as the set-up speaks."""
    for line in text.splitlines():
        print(f"gsplat: {line}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
