"""The table of faults in README.md beside this file names tests that exist, for every fault."""

import ast
import re
from functools import cache
from pathlib import Path

TESTS = Path(__file__).parents[1]
ROWS = re.findall(r"^\| (\d+) \| (.+) \| (.+) \|$", (TESTS / "faults/README.md").read_text(), re.M)
FAULTS = 93


@cache
def functions(path: Path) -> set[str]:
    return {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}


def test_every_fault_has_its_row():
    assert [int(number) for number, _, _ in ROWS] == list(range(1, FAULTS + 1))


def test_every_test_that_the_table_names_exists():
    for number, _, cell in ROWS:
        tests = cell.split("<br>")
        for test in tests:
            named = re.fullmatch(r"`([\w/]+\.py)::(test_\w+)`", test)
            assert named, f"row {number}: {test}"
            assert named[2] in functions(TESTS / named[1]), f"row {number}: {test}"
