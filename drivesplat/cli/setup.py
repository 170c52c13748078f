"""The command `drivesplat setup`: compiles what jobs otherwise compile at the first use, and wait for."""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from drivesplat import SNAKEFILE, WORKFLOW
from drivesplat.errors import ConfigError

COMMAND = "setup"
PRESETS = tuple(str(WORKFLOW / "presets" / name) for name in ("lidar.yaml", "warm_up.yaml"))
TARGETS = ("metrics", "films", "results/demo/street/edits/accelerate_then_stop.mp4")
"""What is made on a card: trainings with and without LiDAR, their metrics, films and an edit. Their jobs run side by
side, and compile the kernels that those of other drives need."""
JOBS_PER_CARD = 4
"""That of PRESETS."""
LAST_LINES = 30
"""Lines of Snakemake's output that are printed if it fails."""


def add_parser(commands: Any) -> None:
    """Adds the command to the subparsers of the command line."""
    setup = commands.add_parser(COMMAND, help="compile the kernels for this machine's GPUs and processors, once")
    setup.add_argument("--gpu-kernels", action="store_true", help="those of this package for the GPUs here, alone")
    text = "compute capabilities, such as 8.6,9.0: the CUDA C++ kernels for GPUs that are not here, alone"
    setup.add_argument("--arch", help=text)


def run_setup(parsed: argparse.Namespace) -> int:
    """Compiles what the arguments ask for. Returns the exit status. Raises ConfigError for an invalid `--arch`."""
    if parsed.arch is not None:
        return compile_for(parsed.arch)
    if not parsed.gpu_kernels:
        from drivesplat.machine.gsplat_build.__main__ import main as compile_gsplat
        from drivesplat.training.warm_up import main as train_briefly
        from drivesplat.world.warm_up import main as make_tiny_world

        status = compile_gsplat([]) or train_briefly() or make_tiny_world()
        if status:
            return status
    return compile_on_cards()


def compile_for(archs: str) -> int:
    """Compiles the CUDA C++ kernels for compute capabilities such as "8.6;9.0". Needs no GPU. Returns the exit status.
    Raises ConfigError where one is malformed, DeviceError where NVRTC cannot compile."""
    from drivesplat.kernels.cuda.compiled import compile_ahead
    from drivesplat.machine.compute_capability import parse_arch

    for arch in archs.replace(";", " ").replace(",", " ").split():
        parsed = parse_arch(arch)
        if parsed is None:
            raise ConfigError(f"--arch: {arch!r} is no compute capability; write numbers such as 8.6,9.0")
        count = compile_ahead("{}{}".format(*parsed[0]))
        print(f"{count} CUDA C++ programs are compiled for {arch}; Triton's kernels are compiled on the first card")
    return 0


def compile_on_cards(run: Callable[[Sequence[str], Path], int] | None = None) -> int:
    """Compiles the kernels for the GPUs of this machine, where there are any and it has not been done, by jobs on a
    tiny drive. `run` runs the workflow with arguments in a folder. Returns the exit status."""
    import torch

    from drivesplat.kernels.triton_support import compiles

    if not torch.cuda.is_available() or not compiles():
        return 0
    mark = mark_of_cards()
    if mark.exists():
        return 0
    print("drivesplat: compiling the kernels for this card; a minute or two, once", file=sys.stderr)
    slots = JOBS_PER_CARD * torch.cuda.device_count()
    arguments = ["--cores", "all", "--resources", f"gpu={slots}", "--configfile", *PRESETS, "--", *TARGETS]
    with tempfile.TemporaryDirectory() as folder:
        status = (run or _run_workflow)(arguments, Path(folder))
    if status:
        print("drivesplat: not all kernels were compiled (see above); the first jobs compile the rest", file=sys.stderr)
        return status
    mark.parent.mkdir(parents=True, exist_ok=True)
    mark.touch()
    return 0


def mark_of_cards() -> Path:
    """The file beside Triton's compiled kernels which says that those of this copy's code are compiled for the kinds of
    GPUs of this machine."""
    import torch
    import triton

    from drivesplat.kernels import triton as kernels
    from drivesplat.provenance.code.code_digest import code_digest

    files = sorted(Path(kernels.__file__).parent.glob("*.py"))
    digest = hashlib.sha256("".join(map(code_digest, files)).encode()).hexdigest()
    capabilities = {torch.cuda.get_device_capability(number) for number in range(torch.cuda.device_count())}
    kinds = "-".join(f"sm{major}{minor}" for major, minor in sorted(capabilities))
    folder = os.environ.get("TRITON_CACHE_DIR") or Path.home() / ".triton" / "cache"
    return Path(folder) / f"drivesplat-{digest[:16]}-{triton.__version__}-{kinds}"


def _run_workflow(arguments: Sequence[str], folder: Path) -> int:
    """Runs Snakemake in a folder; prints the end of what it says if it fails. Returns its exit status."""
    # the current folder is no place to import from: it may be another copy's checkout
    environment = {**os.environ, "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(SNAKEFILE), *arguments]
    done = subprocess.run(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    if done.returncode:
        print("\n".join(done.stdout.splitlines()[-LAST_LINES:]), file=sys.stderr)
    return done.returncode
