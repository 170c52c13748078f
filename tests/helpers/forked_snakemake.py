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
from helpers.forked_scripts import fork_scripts, script_server

_CONTEXT = multiprocessing.get_context("forkserver")
_PRELOADED = [
    "dpath", "encodings.idna", "jsonschema", "smart_open", "snakemake.benchmark", "snakemake.cli", "snakemake.profiles",
    "snakemake.report.html_reporter", "snakemake.storage", "yte",
]  # fmt: skip
"""Snakemake, and what it imports when it is called."""
_CONTEXT.set_forkserver_preload(_PRELOADED)


def run_snakemake(
    arguments: Sequence[str], folder: Path, environment: Mapping[str, str], timeout: float
) -> subprocess.CompletedProcess:
    """`python -m snakemake {arguments}` in a folder; the result holds its output (both streams) as `stdout`.

    Raises subprocess.TimeoutExpired after `timeout` seconds, the process being ended.
    """
    server = None if "-n" in arguments else script_server().address
    reader, writer = _CONTEXT.Pipe(duplex=False)
    process = _CONTEXT.Process(target=_call, args=(list(arguments), str(folder), dict(environment), server, writer))
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


def _call(
    arguments: list[str], folder: str, environment: dict[str, str], server: str | None, output: Connection
) -> None:
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

    if server:
        fork_scripts(server)
    main(arguments)
