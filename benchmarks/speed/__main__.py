"""How fast a method of the workflow trains, held to the plain recipe: gsplat's example trainer on the same data.

    python -m benchmarks.speed benchmarks/speed/demo.yaml
    python -m benchmarks.speed benchmarks/speed/demo_1600.yaml --iterations 7000 --seeds 0 -- --cores 16

Both are trained one after the other, alone on the device, and measured on the same held-out frames; with --cards seeds
are trained side by side, each on a card of its own. Everything after `--` is Snakemake's, which makes what is trained
on. Writes speed.md and speed.json; docs/speed.md says more.
"""

import argparse
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

from benchmarks.quality.runs import passed_on, run
from benchmarks.speed import runs
from benchmarks.speed.alone import in_own_process
from benchmarks.speed.compare import speed
from benchmarks.speed.plan import Task, group_of, read_speed_file, targets_of, tasks_of
from benchmarks.speed.settings import SpeedFile
from benchmarks.speed.table import markdown
from drivesplat.errors import ConfigError, DriveSplatError
from drivesplat.io.storage import atomic_write, write_json
from drivesplat.workflow.gpus import visible_cards

CORES = ("--cores", "all")


def measure(file: SpeedFile, out: Path, arguments: Sequence[str], workflow: Path, cards: int = 1) -> int:
    """Makes what a file's trainings need, with `arguments` for Snakemake, trains and measures, as many seeds at a time
    as `cards`, and writes and prints the tables.

    Returns the exit status: Snakemake's where it failed or only planned. Raises DriveSplatError where the file or the
    arguments are not what they should be, or a training fails; what was measured before it stays written.
    """
    if not (workflow / "Snakefile").is_file():
        raise ConfigError(f"there is no Snakefile in {workflow.resolve()}: call it where Snakemake is called")
    if cards > visible_cards():
        raise ConfigError(f"--cards {cards}: there are {visible_cards()} GPUs that this process may use")
    group, training = group_of(file, out, workflow), passed_on(arguments)
    made = run(group, arguments or CORES, workflow, targets_of(group))
    if made.status or not training:
        return made.status
    measured: list[dict[str, Any]] = []
    one_at_a_time = Lock()

    def train(tasks: Sequence[Task]) -> None:
        for task in tasks:
            print(f"{task.label} ...", flush=True)
            found = in_own_process(runs.run, task)
            print(f"{task.label}: {found['loop']:.1f} s", flush=True)
            with one_at_a_time:
                measured.append(found)
                write(speed(file, measured, []), out)

    with ThreadPoolExecutor(cards) as pool:
        for series in [pool.submit(train, tasks) for tasks in in_series(tasks_of(file, group, out), cards)]:
            series.result()
    profiles = [_profile(task, file.profiled) for task in tasks_of(file, group, out) if _profiled(task, file)]
    page = write(speed(file, measured, profiles), out)
    print(f"\n{page}\nWritten: {out / 'speed.md'} and {out / 'speed.json'}", flush=True)
    return 0


def in_series(tasks: Iterable[Task], cards: int) -> list[list[Task]]:
    """What is trained one after the other: all of it; with several cards what has one seed."""
    series: dict[int, list[Task]] = {}
    for task in tasks:
        series.setdefault(task.seed if cards > 1 else 0, []).append(task)
    return list(series.values())


def write(record: dict[str, Any], out: Path) -> str:
    """Writes speed.json and speed.md; returns the page."""
    page = markdown(record)
    write_json(out / "speed.json", record)
    with atomic_write(out / "speed.md") as written:
        written.write(page.encode())
    return page


def _profiled(task: Task, file: SpeedFile) -> bool:
    """Whether a task's stages are timed: of one seed at each length."""
    return file.profiled > 0 and task.seed == file.seeds[0]


def _profile(task: Task, iterations: int) -> dict[str, Any]:
    print(f"{task.label}: stage by stage ...", flush=True)
    stages = in_own_process(runs.profile, task, iterations)
    return {"recipe": task.recipe, "iterations": task.iterations, "stages": stages}


def main(words: Sequence[str]) -> int:
    """The command with these words; returns its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="what is trained (docs/speed.md)")
    parser.add_argument("--out", type=Path, help="the folder of all results; as a default results/speed/{file's name}")
    parser.add_argument("--iterations", type=int, nargs="+", help="lengths, in place of the file's")
    parser.add_argument("--seeds", type=int, nargs="+", help="random seeds, in place of the file's")
    parser.add_argument("--cards", type=int, default=1, help="so many seeds side by side, each on a GPU of its own")
    split = words.index("--") if "--" in words else len(words)
    told = parser.parse_args(words[:split])
    instead = {key: getattr(told, key) for key in ("iterations", "seeds") if getattr(told, key) is not None}
    out = told.out or Path("results/speed") / told.file.stem
    return measure(read_speed_file(told.file, instead), out, words[split + 1 :], Path(), told.cards)


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except DriveSplatError as error:
        sys.exit(f"drivesplat: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
