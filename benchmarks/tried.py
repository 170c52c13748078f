"""The ledger of experiments: `python -m benchmarks.tried` writes docs/tried.md from docs/tried.csv.

A row of the ledger is one experiment. `commit` has its code or recorded its figures, and `date` is the commit's.
`what` was changed, on which `data`, with which random `seeds` (empty where none matters), and to which `effect`.
`kept` is `yes` (the code or the default has it), `option` (a setting or preset has it), `no`, or `finding` (a
measurement that changed nothing).
"""

import argparse
import csv
import datetime
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"
SECTIONS = {
    "no": ("Not kept", "Tried, measured, and left out or removed. Look here before you try something again."),
    "option": ("Options", "Available as a setting, a preset or a command, and not the default."),
    "yes": ("Kept", "In the code or in the defaults."),
    "finding": ("Findings", "Measurements that explain a result and changed nothing by themselves."),
}
"""The heading and the first sentence of the experiments with each value of `kept`, in the order of the page."""
HEAD = """# Experiments

Generated from [tried.csv](tried.csv) by `make ledger`: add a row there, in the order of dates. What holds today is in
[measured.md](measured.md); longer accounts of experiments up to November 2026 are in the frozen
[archive](../archive/measured-2026-11.md), which has the section, the machine and the command of each.

Differences are in dB of PSNR on held-out images unless they have another unit. A pair is static, then moving vehicles;
± is the standard error over the seeds. *Between* and *beyond* are images between training images and after the last of
them; *from aside* are views from 2 or 4 m beside the recorded path. Worlds are in `benchmarks/worlds`; numbers name
random worlds with people. Two trainings with one seed differ by up to 0.5 dB on a GPU.
"""


@dataclass(frozen=True)
class Experiment:
    """A row of the ledger."""

    date: str
    commit: str
    what: str
    data: str
    seeds: str
    effect: str
    kept: str

    def __post_init__(self) -> None:
        """Raises ValueError if a value is not of its form."""
        datetime.date.fromisoformat(self.date)
        if not re.fullmatch(r"[0-9a-f]{7}", self.commit):
            raise ValueError(f"{self.commit!r}: a commit has seven hexadecimal digits")
        if self.kept not in SECTIONS:
            raise ValueError(f"{self.what}: kept is {self.kept!r}, but has to be one of {', '.join(SECTIONS)}")
        if not (self.what and self.data and self.effect):
            raise ValueError(f"{self.commit} {self.what}: a value is empty")


def read_ledger(path: Path) -> list[Experiment]:
    """The experiments of a CSV file whose columns are the fields of `Experiment`. Raises ValueError otherwise."""
    columns = [field.name for field in fields(Experiment)]
    with path.open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    if header != columns or any(len(row) != len(columns) for row in rows):
        raise ValueError(f"{path}: each line has to have the columns {', '.join(columns)}")
    return [Experiment(*row) for row in rows]


def ledger_page(experiments: Sequence[Experiment]) -> str:
    """The page in Markdown: a table for each value of `kept`, the newest experiment first."""
    parts = [HEAD]
    for kept, (heading, sentence) in SECTIONS.items():
        rows = [it for it in reversed(experiments) if it.kept == kept]
        if rows:
            parts.append(f"\n## {heading}\n\n{sentence}\n\n| date | commit | what | data | seeds | effect |\n")
            parts.append("|---|---|---|---|---|---|\n")
            parts += [
                f"| {it.date} | {it.commit} | {_cell(it.what)} | {_cell(it.data)} | {_cell(it.seeds)} "
                f"| {_cell(it.effect)} |\n"
                for it in rows
            ]
    return "".join(parts)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def main(docs: Path = DOCS) -> int:
    try:
        page = ledger_page(read_ledger(docs / "tried.csv"))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    (docs / "tried.md").write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    argparse.ArgumentParser("python -m benchmarks.tried", description=__doc__).parse_args()
    sys.exit(main())
