"""The ledger of experiments and its page."""

import csv
import subprocess
from pathlib import Path

import pytest
from helpers import REPOSITORY

from benchmarks.tried import ledger_page, main, read_ledger

ROW = ("2026-11-21", "0123abc", "a | b", "demo", "0-2", "+0.1 ± 0.1", "no")


def written(folder: Path, rows: list[tuple[str, ...]]) -> Path:
    with (folder / "tried.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([("date", "commit", "what", "data", "seeds", "effect", "kept"), *rows])
    return folder / "tried.csv"


def test_page_is_generated_from_the_ledger_in_the_order_of_dates_without_duplicates():
    rows = read_ledger(REPOSITORY / "docs/tried.csv")
    assert ledger_page(rows) == (REPOSITORY / "docs/tried.md").read_text(encoding="utf-8"), "run make ledger"
    assert len(rows) > 200 and [it.date for it in rows] == sorted(it.date for it in rows)
    assert len({(it.what, it.data, it.commit) for it in rows}) == len(rows)


def test_commits_of_the_ledger_exist_with_their_dates():
    if subprocess.run(["git", "cat-file", "-e", "499d0e9"], cwd=REPOSITORY, capture_output=True).returncode:
        pytest.skip("not a checkout with the whole history")
    dates = {it.commit: it.date for it in read_ledger(REPOSITORY / "docs/tried.csv")}
    command = ["git", "show", "-s", "--format=%cs", *dates]
    shown = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert shown.stdout.split() == list(dates.values())


def test_newest_experiments_come_first_under_their_heading(tmp_path):
    later = ("2026-11-22", "4567def", "c", "scene 0061", "0", "0.0", "no")
    page = ledger_page(read_ledger(written(tmp_path, [ROW, later, (*ROW[:6], "finding")])))
    no, finding = page.index("## Not kept"), page.index("## Findings")
    assert no < page.index("| 2026-11-22 | 4567def | c | scene 0061 | 0 | 0.0 |") < page.index("| a \\| b |") < finding
    assert page.count("| a \\| b |") == 2 and "## Kept" not in page


@pytest.mark.parametrize(("column", "value"), [(0, "21.11.2026"), (1, "main"), (2, ""), (3, ""), (5, ""), (6, "maybe")])
def test_a_value_of_another_form_stops_the_command(tmp_path, capsys, column, value):
    written(tmp_path, [(*ROW[:column], value, *ROW[column + 1 :])])
    assert main(tmp_path) == 1 and not (tmp_path / "tried.md").exists()
    assert capsys.readouterr().err.count("\n") == 1


def test_a_line_with_another_number_of_columns_is_refused_and_a_page_without_experiments_has_no_table(tmp_path):
    with pytest.raises(ValueError, match="columns date, commit, what"):
        read_ledger(written(tmp_path, [ROW[:6]]))
    assert "##" not in ledger_page([])
