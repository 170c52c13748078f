"""The command `drivesplat setup`: compiles what jobs otherwise compile at the first use, and wait for."""

import argparse
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


def is_for_gpus_alone(parsed: argparse.Namespace) -> bool:
    """Whether the arguments leave out gsplat and the kernels for processors."""
    return parsed.gpu_kernels or parsed.arch is not None


def run_setup(parsed: argparse.Namespace) -> int:
    """Compiles the kernels of this package for GPUs. Returns the exit status. Raises ConfigError for an invalid
    `--arch`."""
    return compile_on_cards() if parsed.arch is None else compile_for(parsed.arch)


def compile_for(archs: str) -> int:
    """Compiles the CUDA C++ kernels for compute capabilities such as "8.6;9.0". Needs no GPU. Returns the exit status.
    Raises ConfigError where one is malformed, DeviceError where NVRTC cannot compile."""
    from drivesplat.kernels.warm_up import compile_cuda
    from drivesplat.machine.compute_capability import parse_arch

    for arch in archs.replace(";", " ").replace(",", " ").split():
        parsed = parse_arch(arch)
        if parsed is None:
            raise ConfigError(f"--arch: {arch!r} is no compute capability; write numbers such as 8.6,9.0")
        count = compile_cuda("{}{}".format(*parsed[0]))
        print(f"{count} CUDA C++ programs are compiled for {arch}; Triton's kernels are compiled on the first card")
    return 0


def compile_on_cards(run: Callable[[Sequence[str], Path], int] | None = None) -> int:
    """Compiles the kernels for the GPUs of this machine, where there are any and it has not been done, by jobs on a
    tiny drive. `run` runs the workflow with arguments in a folder. Returns the exit status."""
    import torch

    from drivesplat.kernels.triton_support import compiles
    from drivesplat.kernels.warm_up import triton_mark

    if not torch.cuda.is_available() or not compiles():
        return 0
    cards = range(torch.cuda.device_count())
    mark = triton_mark({torch.cuda.get_device_capability(card) for card in cards})
    if mark.exists():
        return 0
    print("drivesplat: compiling the kernels for this card; a minute or two, once", file=sys.stderr)
    slots = JOBS_PER_CARD * len(cards)
    arguments = ["--cores", "all", "--resources", f"gpu={slots}", "--configfile", *PRESETS, "--", *TARGETS]
    with tempfile.TemporaryDirectory() as folder:
        status = (run or _run_workflow)(arguments, Path(folder))
    if status:
        print("drivesplat: not all kernels were compiled (see above); the first jobs compile the rest", file=sys.stderr)
        return status
    mark.parent.mkdir(parents=True, exist_ok=True)
    mark.touch()
    return 0


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
