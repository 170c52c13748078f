"""The cache of compiled functions is invalidated by every change of code that is compiled into them."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
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
LOAD = """
from drivesplat.callee import scaled
print([scaled(2), scaled(2.0), scaled(2j)], sum(scaled.stats.cache_hits.values()))
"""
SERVER = """
import errno, fcntl, json, os, sys
from numba import config, njit
njit("int64(int64)")(lambda number: number)  # sets up the compiler
def flock(*_):
    raise OSError(errno.ENOLCK, "no locks")
for line in sys.stdin:
    root, variables, locks = json.loads(line)
    if not os.fork():
        os.environ.update(variables)
        config.reload_config()
        sys.path.insert(0, root)
        if not locks:
            fcntl.flock = flock
        from drivesplat.caller import total
        print(total(10.0), sum(total.stats.cache_hits.values()), flush=True)
        os._exit(0)
    assert os.wait()[1] == 0
"""
"""Runs the kernel of each package that it is told in a process of its own, which need not import numba again."""


USED = (
    "kernels/cache kernels/cache_folder kernels/numba_private provenance/code/code_digest "
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


def environment(root: Path) -> dict[str, str]:
    """The environment of a process that uses the package at `root`."""
    known = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    return {**known, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[subprocess.Popen]:
    nowhere = tmp_path_factory.mktemp("nowhere")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", SERVER], env=environment(nowhere), cwd=nowhere, **pipes) as process:
        yield process
        process.stdin.close()


@pytest.fixture
def show(server) -> Callable[..., tuple[float, int]]:
    """The kernel's value in a new process, and its number of cache hits.

    The process writes no bytecode, which Python would also use for another source of the same size and second.
    """

    def shown(root: Path, locks: bool = True, **variables: str) -> tuple[float, int]:
        print(json.dumps([str(root), variables, locks]), file=server.stdin, flush=True)
        value, hits = server.stdout.readline().split()
        return float(value), int(hits)

    return shown


def test_compiled_code_is_cached_until_an_imported_constant_changes_and_removed_after_two_weeks_unused(show, tmp_path):
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


def test_checkouts_of_the_same_code_share_the_cache_in_a_folder_of_the_users(show, tmp_path):
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


def test_the_users_cache_replaces_a_read_only_installation_also_where_files_cannot_be_locked(show, tmp_path):
    package, home = small_package(tmp_path), tmp_path / "home"
    (package / "__pycache__").write_text("a file, so that nothing can be written below it")
    home.mkdir()
    assert show(tmp_path, locks=False, HOME=str(home)) == (22.0, 0)
    assert show(tmp_path, locks=False, HOME=str(home)) == (22.0, 1)
    assert len(list((home / ".cache" / "drivesplat").glob("kernels-caller-*"))) == 1


@pytest.mark.slow
def test_processes_that_compile_other_signatures_at_the_same_time_share_the_cache(tmp_path):
    """They begin together, and each waits for a second between its reading and writing of the index."""
    small_package(tmp_path, 3.0)
    run = {"cwd": tmp_path, "env": environment(tmp_path)}
    compiling = [subprocess.Popen([sys.executable, "-c", COMPILE_SLOWLY, x], **run) for x in ("2", "2.0", "2j")]
    assert [process.wait() for process in compiling] == [0, 0, 0]
    loaded = subprocess.run([sys.executable, "-c", LOAD], **run, capture_output=True, text=True, check=True)
    assert loaded.stdout.strip() == "[6.0, 6.0, 6j] 3"
