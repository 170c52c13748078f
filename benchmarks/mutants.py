"""Applies deliberate faults to a copy of the project, one at a time, and reports which test finds each.

The faults are those of benchmarks/mutants.yaml. A fault that survives shows a missing test. At the end all tests that
have found a fault are run without any, and must pass.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.command import argument_parser, run_command
from drivesplat.errors import ConfigError
from drivesplat.io.yaml_file import read_yaml
from drivesplat.settings import Settings, validated

REPOSITORY = Path(__file__).parents[1]
FAULTS = Path(__file__).with_suffix(".yaml")
LIBRARY = "drivesplat"
MARKERS = "not gpu and not slurm and not batch and not slow and not viewers"
"""The tests of `make test`."""


class Fault(Settings):
    """A fault: the text `new` instead of `old`, its `effect` for a user, and the `tests` that should find it."""

    name: str
    old: str
    new: str
    effect: str
    tests: tuple[str, ...]


def read_faults(path: Path = FAULTS) -> tuple[Fault, ...]:
    """The rows of a file of faults. Raises ConfigError for a wrong one."""
    return tuple(validated(Fault, row) for row in read_yaml(path, "file of faults"))


def library_sources(root: Path) -> dict[Path, str]:
    """The Python files of the library in the project at `root`, and their texts."""
    files = (path for path in sorted((root / LIBRARY).rglob("*.py")) if "__pycache__" not in path.parts)
    return {path: path.read_text(encoding="utf-8") for path in files}


def faulty_file(fault: Fault, sources: dict[Path, str]) -> Path:
    """The file that a fault changes. Raises ConfigError unless its `old` text occurs exactly once."""
    counts = {path: text.count(fault.old) for path, text in sources.items() if fault.old in text}
    if sum(counts.values()) != 1:
        places = ", ".join(map(str, counts)) or "no file"
        raise ConfigError(f"{FAULTS.name}: 'old' of {fault.name} must occur once, but occurs in {places}")
    return next(iter(counts))


def copy_project(folder: Path) -> None:
    """Copies all files that git tracks to `folder`."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if (REPOSITORY / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(REPOSITORY / name, folder / name)


def run_tests(folder: Path, tests: Iterable[str], workers: int) -> tuple[int, str]:
    """The exit status of pytest and its output."""
    cache = {"NUMBA_CACHE_DIR": str(REPOSITORY / LIBRARY / "__pycache__")} | os.environ  # compiled code by its content
    command = [sys.executable, "-m", "pytest", "-q", "-rfE", "-p", "no:cacheprovider", "-n", str(workers)]
    command += ["-m", MARKERS, *tests]
    done = subprocess.run(command, cwd=folder, env=cache, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def finder(fault: Fault, folder: Path, tests: Sequence[str], workers: int) -> str | None:
    """The test that fails with a fault in the copy at `folder`, which is restored; None if all tests pass. Raises
    ConfigError where they cannot be run."""
    path = faulty_file(fault, sources := library_sources(folder))
    path.write_text(sources[path].replace(fault.old, fault.new), encoding="utf-8")
    try:
        status, output = run_tests(folder, ["-x", *tests], workers)
    finally:
        path.write_text(sources[path], encoding="utf-8")
    if status == 0:
        return None
    failed = re.search(r"^(?:FAILED|ERROR) ([^\s\[]+)", output, re.M)
    if failed is None:
        raise ConfigError(f"{fault.name}: pytest ends with status {status}:\n{output[-2000:]}")
    return failed[1]


def main(arguments: Sequence[str]) -> int:
    parser = argument_parser("mutants", __doc__)
    parser.add_argument("--only", action="append", metavar="NAME", help="try this fault; may be repeated")
    parser.add_argument("--suite", action="store_true", help="run all tests of `make test` instead of the named ones")
    parser.add_argument("--workers", type=int, default=0, help="processes that run tests (default: one)")
    options = parser.parse_args(arguments)
    faults = {fault.name: fault for fault in read_faults()}
    if unknown := set(options.only or ()) - faults.keys():
        raise ConfigError(f"no fault is called {min(unknown)}; there are: {', '.join(faults)}")
    chosen = {name: faults[name] for name in options.only or faults}
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="drivesplat-mutants-") as name:
        copy_project(folder := Path(name))
        for fault in chosen.values():
            test = finder(fault, folder, ["tests"] if options.suite else fault.tests, options.workers)
            found |= {fault.name: test} if test else {}
            print(f"{fault.name}: " + (f"found by {test}" if test else f"SURVIVED ({fault.effect})"), flush=True)
        status, output = run_tests(folder, sorted(set(found.values())), options.workers) if found else (0, "")
    if status:
        raise ConfigError(f"some of these tests fail without a fault, too:\n{output[-2000:]}")
    print(f"{len(found)} of {len(chosen)} faults are found")
    return int(len(found) < len(chosen))


if __name__ == "__main__":
    run_command(main)
