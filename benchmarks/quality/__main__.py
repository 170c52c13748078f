"""What recipes are worth on one scene: each trained with several random seeds, measured, and put into a table.

    python -m benchmarks.quality benchmarks/recipes/demo.yaml -- --cores 4
    python -m benchmarks.quality mine.yaml --out results/quality/mine -- --cores 16 --resources gpu=4 --scheduler greedy

Everything after `--` is Snakemake's. What is measured stays: an interrupted call is repeated as it was. Writes
quality.md and quality.json; ends with 1 where a recipe has no result with some seed. docs/quality.md says more.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.quality.compare import quality
from benchmarks.quality.groups import groups_of, read_recipes
from benchmarks.quality.results import results_of
from benchmarks.quality.runs import passed_on, run
from benchmarks.quality.table import markdown
from drivesplat.errors import ConfigError, DriveSplatError
from drivesplat.io.storage import atomic_write, write_json


def measure(file: Path, out: Path, arguments: Sequence[str], workflow: Path) -> int:
    """Trains and measures the recipes of a file, with `arguments` for Snakemake, and writes and prints their table.

    Returns the exit status: 0 where every recipe has a result with every seed. Raises DriveSplatError where the file or
    the arguments are not what they should be.
    """
    if not (workflow / "Snakefile").is_file():
        raise ConfigError(f"there is no Snakefile in {workflow.resolve()}: call it where Snakemake is called")
    recipes = read_recipes(file)
    groups, training = groups_of(recipes, out, workflow), passed_on(arguments)
    ended = [(group, run(group, arguments, workflow)) for group in groups]
    status = max(outcome.status for _, outcome in ended)
    if not training:
        return status
    record = quality(recipes, results_of(ended))
    page = markdown(record)
    write_json(out / "quality.json", record)
    with atomic_write(out / "quality.md") as written:
        written.write(page.encode())
    print(f"\n{page}\nWritten: {out / 'quality.md'} and {out / 'quality.json'}", flush=True)
    return 1 if record["failed"] else status


def main(words: Sequence[str]) -> int:
    """The command with these words; returns its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recipes", type=Path, help="the file of recipes (docs/quality.md)")
    parser.add_argument(
        "--out", type=Path, help="the folder of all results; as a default results/quality/{the file's name}"
    )
    split = words.index("--") if "--" in words else len(words)
    told = parser.parse_args(words[:split])
    out = told.out or Path("results/quality") / told.recipes.stem
    return measure(told.recipes, out, words[split + 1 :], Path())


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except DriveSplatError as error:
        sys.exit(f"drivesplat: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
