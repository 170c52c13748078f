"""The cache of compiled functions is invalidated by every change of code that is compiled into them."""

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
COMPILE_SLOWLY = """
import pathlib, sys, time
from numba.core.caching import IndexDataCacheFile
read = IndexDataCacheFile._load_index
def read_and_wait(self):
    index = read(self)
    time.sleep(1.0)
    return index
from drivesplat.callee import scaled
IndexDataCacheFile._load_index = read_and_wait
pathlib.Path(f"ready-{sys.argv[1]}").touch()
while len(list(pathlib.Path().glob("ready-*"))) < 3:
    time.sleep(0.01)
scaled(eval(sys.argv[1]))
"""
NO_LOCKS = """
import errno, fcntl

def flock(*_):
    raise OSError(errno.ENOLCK, "no locks")

fcntl.flock = flock
"""
LOAD = """
from drivesplat.callee import scaled
print([scaled(2), scaled(2.0), scaled(2j)], sum(scaled.stats.cache_hits.values()))
"""
SHOW = "from drivesplat.caller import total\nprint(total(10.0))\nprint(sum(total.stats.cache_hits.values()))\n"


USED = (
    "kernels/cache kernels/cache_folder kernels/numba_private provenance/code_digest provenance/syntax_digest "
    "io/file_lock io/regular_file io/storage errors"
)
"""Modules that `drivesplat.kernels.cache` imports."""


def small_package(root: Path, scale: float = 2.0) -> Path:
    """A package of the library's name with kernels only: code digests follow the imports of a kernel."""
    package = root / "drivesplat"
    for name in USED.split():
        file = package / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        (file.parent / "__init__.py").write_text("")
        file.write_text((REPOSITORY / "drivesplat" / f"{name}.py").read_text())
    (package / "caller.py").write_text(CALLER)
    (package / "callee.py").write_text(CALLEE.format(scale=scale))
    return package


def environment(root: Path, **variables: str) -> dict[str, str]:
    """The environment of a process that uses the package at `root`."""
    known = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    return {**known, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1", **variables}


def show(root: Path, **variables: str) -> tuple[float, int]:
    """The kernel's value in a new process, and its number of cache hits.

    The process writes no bytecode, which Python would also use for another source of the same size and second.
    """
    env = environment(root, **variables)
    done = subprocess.run([sys.executable, "-c", SHOW], env=env, cwd=root, capture_output=True, text=True, check=True)
    value, hits = done.stdout.split()
    return float(value), int(hits)


def test_compiled_code_is_cached_until_an_imported_constant_changes_and_removed_after_two_weeks_unused(tmp_path):
    package = small_package(tmp_path)
    assert show(tmp_path) == (22.0, 0)
    assert show(tmp_path) == (22.0, 1)
    (package / "callee.py").write_text(CALLEE.format(scale=3.0))
    assert show(tmp_path) == (33.0, 0), "numba alone would have kept 22"
    folders = sorted((package / "__pycache__").glob("kernels-caller-*"), key=lambda path: path.stat().st_mtime)
    assert len(folders) == 2, "another run may still use the earlier one"
    weeks_ago = folders[0].stat().st_mtime - 15 * 24 * 3600
    for folder in folders:
        os.utime(folder, (weeks_ago, weeks_ago))
    assert show(tmp_path) == (33.0, 1)
    assert list((package / "__pycache__").glob("kernels-caller-*")) == [folders[1]]


def test_checkouts_of_the_same_code_share_the_cache_in_a_folder_of_the_users(tmp_path):
    """Comments and file times do not change the code."""
    caches, roots = tmp_path / "cache", [tmp_path / name for name in ("one", "another")]
    for root in roots:
        root.mkdir()
        small_package(root)
    assert show(roots[0], NUMBA_CACHE_DIR=str(caches)) == (22.0, 0)
    assert list(caches.glob("kernels-caller-*")) and not list(roots[0].rglob("__pycache__/kernels-*"))
    (roots[1] / "drivesplat/caller.py").write_text(CALLER + "# the same code\n")
    assert show(roots[1], NUMBA_CACHE_DIR=str(caches)) == (22.0, 1)
    (roots[1] / "drivesplat/callee.py").write_text(CALLEE.format(scale=3.0))
    assert show(roots[1], NUMBA_CACHE_DIR=str(caches)) == (33.0, 0)


def test_the_users_cache_replaces_a_read_only_installation_also_where_files_cannot_be_locked(tmp_path):
    package, home = small_package(tmp_path), tmp_path / "home"
    (package / "__pycache__").write_text("a file, so that nothing can be written below it")
    (tmp_path / "sitecustomize.py").write_text(NO_LOCKS)
    home.mkdir()
    assert show(tmp_path, HOME=str(home)) == (22.0, 0)
    assert show(tmp_path, HOME=str(home)) == (22.0, 1)
    assert len(list((home / ".cache" / "drivesplat").glob("kernels-caller-*"))) == 1


def test_processes_that_compile_other_signatures_at_the_same_time_share_the_cache(tmp_path):
    """They begin together, and each waits for a second between its reading and writing of the index."""
    small_package(tmp_path, 3.0)
    run = {"cwd": tmp_path, "env": environment(tmp_path)}
    compiling = [subprocess.Popen([sys.executable, "-c", COMPILE_SLOWLY, x], **run) for x in ("2", "2.0", "2j")]
    assert [process.wait() for process in compiling] == [0, 0, 0]
    loaded = subprocess.run([sys.executable, "-c", LOAD], **run, capture_output=True, text=True, check=True)
    assert loaded.stdout.strip() == "[6.0, 6.0, 6j] 3"
