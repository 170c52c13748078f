"""`python -m benchmarks.starts [SCRIPT ...]`: what each script of a rule takes before its work begins.

Prints a line per script: the least processor seconds of three starts up to `with job(`, Snakemake's part included; and
the seconds of it that Python spends in the modules of some packages, those of one start, without the modules that these
import in turn. Other programs disturb the seconds of packages more than the first figure.
"""

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
SCRIPTS = ROOT / "workflow_scripts"
STARTS = 3
PREAMBLE = """
import pickle, sys
class Snakemake: pass
snakemake = Snakemake()
from snakemake.logging import logger
from snakemake.iocontainers import Snakemake
"""
"""As Snakemake writes before a script, but for the pickled description of the job."""
ENDING = '\nimport os, sys; print(int("torch" in sys.modules), flush=True); os._exit(0)\n'
PACKAGES = ("torch", "scipy", "cv2", "pandas", "matplotlib", "numba", "pydantic", "drivesplat")
TIMED = re.compile(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\w+)")


def start_of(script: str, folder: Path) -> tuple[float, bool, Counter[str]]:
    """The least processor seconds of a start, whether it imports torch, and the seconds by package."""
    source, file = (SCRIPTS / f"{script}.py").read_text(encoding="utf-8"), folder / f"{script}.py"
    file.write_text(PREAMBLE + source[: source.index("\nwith job(")] + ENDING, encoding="utf-8")
    environment, least = {**os.environ, "PYTHONPATH": str(ROOT)}, float("inf")
    for _ in range(STARTS):
        before = used()
        done = subprocess.run([sys.executable, file], env=environment, capture_output=True, text=True, check=True)
        least = min(least, used() - before)
    command = [sys.executable, "-X", "importtime", str(file)]
    timed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr
    seconds: Counter[str] = Counter()
    for microseconds, package in TIMED.findall(timed):
        seconds[package] += int(microseconds) / 1e6
    return least, done.stdout.strip() == "1", seconds


def used() -> float:
    """The processor seconds of all processes that this one has waited for."""
    found = resource.getrusage(resource.RUSAGE_CHILDREN)
    return found.ru_utime + found.ru_stime


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser("python -m benchmarks.starts", description=__doc__)
    parser.add_argument("scripts", nargs="*", metavar="SCRIPT", help="names in workflow_scripts/ (all)")
    scripts = parser.parse_args(arguments).scripts
    print(f"{'script':24}{'start':>7}{'torch?':>8}", *(f"{name:>11}" for name in PACKAGES))
    with tempfile.TemporaryDirectory() as folder:
        for script in scripts or sorted(path.stem for path in SCRIPTS.glob("*.py")):
            least, with_torch, seconds = start_of(script, Path(folder))
            figures = (f"{seconds[name]:11.2f}" for name in PACKAGES)
            print(f"{script:24}{least:7.2f}{'yes' if with_torch else 'no':>8}", *figures, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
