"""Compares the training speed of a method with gsplat's example trainer (the plain recipe) on the same data.

    python -m benchmarks.speed benchmarks/speed/demo.yaml
    python -m benchmarks.speed benchmarks/speed/demo_1600.yaml --iterations 7000 --seeds 0 -- --cores 16

All recipes train in turns, alone on the device, and are measured on the same held-out frames; with --cards the seeds
train side by side, each on its own GPU. Arguments after `--` are Snakemake's, which prepares the training data. Writes
speed.md and speed.json. See docs/speed.md.
"""

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

from benchmarks.command import argument_parser, print_page, require_workflow, run_command, split_arguments, write_record
from benchmarks.snakemake_run import is_dry_run
from benchmarks.speed import runs
from benchmarks.speed.compare import speed
from benchmarks.speed.own_process import run_in_process
from benchmarks.speed.plain import VARIANTS
from benchmarks.speed.plan import Task, plan_run, read_speed_file, targets_of, tasks_of
from benchmarks.speed.settings import SpeedFile
from benchmarks.speed.table import markdown
from drivesplat.errors import ConfigError
from drivesplat.workflow.gpus import visible_gpus

CORES = ("--cores", "all")


def measure(file: SpeedFile, out: Path, arguments: Sequence[str], workflow: Path, cards: int = 1) -> int:
    """Prepares the training data with `arguments` for Snakemake, trains and measures as many seeds at a time as
    `cards`, and writes and prints the tables.

    Returns the exit status: Snakemake's if it failed or only planned. Raises DriveSplatError if the file or the
    arguments are invalid, or a training fails; earlier measurements stay written.
    """
    require_workflow(workflow)
    if cards > visible_gpus():
        raise ConfigError(f"--cards {cards}: there are {visible_gpus()} GPUs that this process may use")
    packed = [name for name in file.baselines if VARIANTS[name].packed]
    if packed and not visible_gpus():
        raise ConfigError(f"baselines: {packed[0]} needs a GPU, and this process may use none; leave it out")
    run, dry_run = plan_run(file, out, workflow), is_dry_run(arguments)
    outcome = run.start(arguments or CORES, workflow, targets_of(run))
    if outcome.status or dry_run:
        return outcome.status
    measured: list[dict[str, Any]] = []
    one_at_a_time = Lock()

    def train(tasks: Sequence[Task]) -> None:
        for task in tasks:
            print(f"{task.label} ...", flush=True)
            result = run_in_process(runs.run, task)
            print(f"{task.label}: {result['loop']:.1f} s", flush=True)
            with one_at_a_time:
                measured.append(result)
                write(speed(file, measured, []), out)

    with ThreadPoolExecutor(cards) as pool:
        for series in [pool.submit(train, tasks) for tasks in in_series(tasks_of(file, run, out), cards)]:
            series.result()
    profiles = [_profile(task, file.profiled) for task in tasks_of(file, run, out) if _is_profiled(task, file)]
    print_page(write(speed(file, measured, profiles), out), out, "speed")
    return 0


def in_series(tasks: Iterable[Task], cards: int) -> list[list[Task]]:
    """The tasks as series that run side by side: one series, or one per seed if there are several cards."""
    series: dict[int, list[Task]] = {}
    for task in tasks:
        series.setdefault(task.seed if cards > 1 else 0, []).append(task)
    return list(series.values())


def write(record: dict[str, Any], out: Path) -> str:
    """Writes speed.json and speed.md; returns the page."""
    page = markdown(record)
    write_record(record, page, out, "speed")
    return page


def _is_profiled(task: Task, file: SpeedFile) -> bool:
    """Whether a task's stages are timed: those of the first seed for each length."""
    return file.profiled > 0 and task.seed == file.seeds[0]


def _profile(task: Task, iterations: int) -> dict[str, Any]:
    print(f"{task.label}: stage by stage ...", flush=True)
    stages = run_in_process(runs.profile, task, iterations)
    return {"recipe": task.recipe, "iterations": task.iterations, "stages": stages}


def main(arguments: Sequence[str]) -> int:
    """Runs the command with these arguments; returns its exit status."""
    parser = argument_parser("speed", __doc__)
    parser.add_argument("file", type=Path, help="the speed file (docs/speed.md)")
    parser.add_argument("--out", type=Path, help="the results folder; default: results/speed/{the file's name}")
    parser.add_argument("--iterations", type=int, nargs="+", help="training lengths, in place of the file's")
    parser.add_argument("--seeds", type=int, nargs="+", help="random seeds, in place of the file's")
    parser.add_argument(
        "--cards", type=int, default=1, help="number of seeds to train side by side, each on its own GPU"
    )
    own, snakemake = split_arguments(arguments)
    options = parser.parse_args(own)
    changes = {key: getattr(options, key) for key in ("iterations", "seeds") if getattr(options, key) is not None}
    out = options.out or Path("results/speed") / options.file.stem
    return measure(read_speed_file(options.file, changes), out, snakemake, Path(), options.cards)


if __name__ == "__main__":
    run_command(main)
