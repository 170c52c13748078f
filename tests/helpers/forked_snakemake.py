"""Snakemake called as a process of its own that need not import it again: forked from one that has, and nothing else.

Most of what a call for a tiny world takes is that import, and the suite makes hundreds of them.
"""

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path

from helpers import REPOSITORY

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["snakemake.cli"])


def run_snakemake(
    arguments: Sequence[str], folder: Path, environment: Mapping[str, str], timeout: float
) -> subprocess.CompletedProcess:
    """`python -m snakemake {arguments}` in a folder; the result holds its output (both streams) as `stdout`.

    Raises subprocess.TimeoutExpired after `timeout` seconds, the process being ended.
    """
    reader, writer = _CONTEXT.Pipe(duplex=False)
    process = _CONTEXT.Process(target=_call, args=(list(arguments), str(folder), dict(environment), writer))
    process.start()
    writer.close()
    with ThreadPoolExecutor(1) as threads, open(os.dup(reader.fileno()), encoding="utf-8", errors="replace") as stream:
        output = threads.submit(stream.read)
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired(list(arguments), timeout, output.result())
        return subprocess.CompletedProcess(list(arguments), process.exitcode, output.result())


def _call(arguments: list[str], folder: str, environment: dict[str, str], output: Connection) -> None:
    """In the forked process: as if Python had been started there for Snakemake."""
    for descriptor in (1, 2):
        os.dup2(output.fileno(), descriptor)
    output.close()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    outside = [path for path in sys.path if path and Path(path).resolve() not in (REPOSITORY, REPOSITORY / "tests")]
    sys.path[:] = [folder, *outside]
    sys.argv = ["snakemake", *arguments]

    from snakemake.cli import main

    main(arguments)
