"""Compares recipes on one scene: each is trained with several random seeds and measured on held-out frames.

    python -m benchmarks.quality benchmarks/recipes/demo.yaml -- --cores 4
    python -m benchmarks.quality mine.yaml --out results/quality/mine -- --cores 16 --resources gpu=4 --scheduler greedy

Arguments after `--` are Snakemake's. Finished results stay: repeat an interrupted command as it was. Writes quality.md
and quality.json, and ends with status 1 if a recipe has no result for some seed. See docs/quality.md.
"""

from collections.abc import Sequence
from pathlib import Path

from benchmarks.command import argument_parser, print_page, require_workflow, run_command, split_arguments, write_record
from benchmarks.quality.compare import quality
from benchmarks.quality.recipes import plan_runs, read_recipes
from benchmarks.quality.results import collect_results
from benchmarks.quality.table import markdown
from benchmarks.snakemake_run import is_dry_run


def measure(path: Path, out: Path, arguments: Sequence[str], workflow: Path) -> int:
    """Trains and measures the recipes of a file, with `arguments` for Snakemake, and writes and prints their table.

    Returns the exit status: 0 if every recipe has a result for every seed. Raises DriveSplatError if the file or the
    arguments are invalid.
    """
    require_workflow(workflow)
    file = read_recipes(path)
    runs, dry_run = plan_runs(file, out, workflow), is_dry_run(arguments)
    ended = [(run, run.start(arguments, workflow)) for run in runs]
    status = max(outcome.status for _, outcome in ended)
    if dry_run:
        return status
    record = quality(file, collect_results(ended))
    page = markdown(record)
    write_record(record, page, out, "quality")
    print_page(page, out, "quality")
    return 1 if record["failed"] else status


def main(arguments: Sequence[str]) -> int:
    """Runs the command with these arguments; returns its exit status."""
    parser = argument_parser("quality", __doc__)
    parser.add_argument("recipes", type=Path, help="the recipe file (docs/quality.md)")
    parser.add_argument("--out", type=Path, help="the results folder; default: results/quality/{the file's name}")
    own, snakemake = split_arguments(arguments)
    options = parser.parse_args(own)
    out = options.out or Path("results/quality") / options.recipes.stem
    return measure(options.recipes, out, snakemake, Path())


if __name__ == "__main__":
    run_command(main)
