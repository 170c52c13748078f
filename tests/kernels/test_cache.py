"""Compiled functions: what is kept on disk goes when anything compiled into it changes."""

import os
import subprocess
import sys
from pathlib import Path

from helpers import REPOSITORY

CALLEE = (
    "from drivesplat.kernels.cache import kernel\n\nSCALE = {scale}\n\n\n"
    "@kernel\ndef scaled(x):\n    return SCALE * x\n"
)
CALLER = (
    "from drivesplat.kernels.cache import kernel\nfrom drivesplat.callee import SCALE, scaled\n\n\n"
    "@kernel\ndef total(x):\n    return scaled(x) + SCALE\n"
)
SHOW = "from drivesplat.caller import total\nprint(total(10.0))\nprint(sum(total.stats.cache_hits.values()))\n"


def small_package(root: Path) -> Path:
    """A package of this one's name with nothing but kernels in it: its digests see what a kernel imports."""
    package = root / "drivesplat"
    used = ("kernels/cache", "provenance/code_digest", "provenance/syntax_digest", "io/storage", "errors")
    for name in used:
        file = package / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        (file.parent / "__init__.py").write_text("")
        file.write_text((REPOSITORY / "drivesplat" / f"{name}.py").read_text())
    (package / "caller.py").write_text(CALLER)
    return package


def show(root: Path, **environment: str) -> tuple[float, int]:
    """The kernel's value in a fresh process, and how often it was found on disk.

    The process leaves no bytecode behind: Python would take it for that of a file of the same size which a test writes
    in the same second.
    """
    known = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    env = {**known, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1", **environment}
    done = subprocess.run([sys.executable, "-c", SHOW], env=env, cwd=root, capture_output=True, text=True, check=True)
    value, hits = done.stdout.split()
    return float(value), int(hits)


def test_what_was_compiled_is_kept_until_an_imported_constant_changes(tmp_path):
    package = small_package(tmp_path)
    (package / "callee.py").write_text(CALLEE.format(scale=2.0))
    assert show(tmp_path) == (22.0, 0)
    assert show(tmp_path) == (22.0, 1)
    (package / "callee.py").write_text(CALLEE.format(scale=3.0))
    assert show(tmp_path) == (33.0, 0), "numba alone would have kept 22"


def test_checkouts_of_the_same_code_share_what_they_compile(tmp_path):
    """And a comment, or the time of a file, makes no other code."""
    caches, roots = str(tmp_path / "cache"), [tmp_path / name for name in ("one", "another")]
    for root in roots:
        root.mkdir()
        (small_package(root) / "callee.py").write_text(CALLEE.format(scale=2.0))
    assert show(roots[0], NUMBA_CACHE_DIR=caches) == (22.0, 0)
    (roots[1] / "drivesplat/caller.py").write_text(CALLER + "# the same code\n")
    assert show(roots[1], NUMBA_CACHE_DIR=caches) == (22.0, 1)
    (roots[1] / "drivesplat/callee.py").write_text(CALLEE.format(scale=3.0))
    assert show(roots[1], NUMBA_CACHE_DIR=caches) == (33.0, 0)
    assert show(roots[0], NUMBA_CACHE_DIR=caches) == (22.0, 1)


def test_what_earlier_code_left_goes_after_two_weeks_and_not_before(tmp_path):
    package = small_package(tmp_path)
    (package / "callee.py").write_text(CALLEE.format(scale=2.0))
    show(tmp_path)
    (package / "callee.py").write_text(CALLEE.format(scale=3.0))
    show(tmp_path)
    folders = sorted((package / "__pycache__").glob("kernels-caller-*"), key=lambda path: path.stat().st_mtime)
    assert len(folders) == 2, "another run may still use the earlier one"
    weeks_ago = folders[0].stat().st_mtime - 15 * 24 * 3600
    for folder in folders:
        os.utime(folder, (weeks_ago, weeks_ago))
    assert show(tmp_path) == (33.0, 1)
    assert list((package / "__pycache__").glob("kernels-caller-*")) == [folders[1]]


def test_where_the_installation_cannot_be_written_the_users_cache_is_used_just_as_carefully(tmp_path):
    package = small_package(tmp_path)
    (package / "callee.py").write_text(CALLEE.format(scale=2.0))
    (package / "__pycache__").write_text("a file, so that nothing can be written below it")
    home = tmp_path / "home"
    home.mkdir()
    assert show(tmp_path, HOME=str(home)) == (22.0, 0)
    assert show(tmp_path, HOME=str(home)) == (22.0, 1)
    (package / "callee.py").write_text(CALLEE.format(scale=3.0))
    assert show(tmp_path, HOME=str(home)) == (33.0, 0)
    assert len(list((home / ".cache" / "drivesplat").glob("kernels-caller-*"))) == 2


def test_a_folder_that_is_named_for_the_cache_is_used(tmp_path):
    package = small_package(tmp_path)
    (package / "callee.py").write_text(CALLEE.format(scale=2.0))
    elsewhere = tmp_path / "cache"
    show(tmp_path, NUMBA_CACHE_DIR=str(elsewhere))
    assert list(elsewhere.glob("kernels-caller-*")) and not list(package.glob("__pycache__/kernels-*"))
    assert show(tmp_path, NUMBA_CACHE_DIR=str(elsewhere)) == (22.0, 1)
