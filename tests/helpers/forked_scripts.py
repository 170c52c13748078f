"""Scripts of rules run in processes that need not import torch again: forked from one that has, and nothing of ours.

A script for a tiny world computes for a tenth of a second, after two seconds of imports.
"""

import gc
import json
import multiprocessing
import os
import socket
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Any, TextIO

_PRELOADED = [
    "cv2", "ffmpeg", "imageio_ffmpeg", "jaxtyping", "matplotlib.figure", "PIL.Image", "plyfile", "pxr.Usd",
    "pydantic.json_schema", "scipy.interpolate", "scipy.ndimage", "scipy.spatial.transform", "scipy.stats",
    "skimage.metrics", "snakemake.io", "snakemake.logging", "torch", "torch.utils.tensorboard", "trimesh",
]  # fmt: skip
"""Modules of other packages that scripts import."""
_FORK = multiprocessing.get_context("fork")


@dataclass(frozen=True)
class ScriptServer:
    """The process that others are forked from, which ends with this one, and the socket at which it is asked."""

    process: subprocess.Popen
    folder: tempfile.TemporaryDirectory

    @property
    def address(self) -> str:
        return f"{self.folder.name}/socket"


@cache
def script_server() -> ScriptServer:
    """The one of this process, started when first asked for."""
    folder, environment = tempfile.TemporaryDirectory(), {**os.environ, "PYTHONPATH": ""}
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"{folder.name}/socket")
        listener.listen()
        command, passed = [sys.executable, __file__, str(listener.fileno())], [listener.fileno()]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=passed, env=environment)
    return ScriptServer(process, folder)


def fork_scripts(address: str) -> None:
    """Has the Snakemake of this process run the scripts of its rules by the server at `address`."""
    from snakemake.benchmark import benchmarked
    from snakemake.script import PythonScript

    def execute_script(self: Any, fname: str, edit: bool = False) -> None:
        environment = {**os.environ, "OMP_NUM_THREADS": str(self.threads), "TMPDIR": str(self.resources.tmpdir)}
        with socket.socket(socket.AF_UNIX) as connection, connection.makefile("rw") as stream:
            connection.connect(address)
            socket.send_fds(connection, [b"."], [1, 2])
            print(json.dumps([fname, str(Path.cwd()), environment]), file=stream, flush=True)
            with benchmarked(int(stream.readline()), self.bench_record):
                code = int(stream.readline())
        if code:
            raise subprocess.CalledProcessError(code, f"{sys.executable} {fname}")

    PythonScript.execute_script = execute_script


def _serve(listener: socket.socket) -> None:
    """Starts a process for each script that is asked for, and answers with its id and, at its end, its exit code."""
    running: dict[int, tuple[BaseProcess, TextIO]] = {}
    while True:
        for ready in wait([listener, sys.stdin, *running]):
            if ready is sys.stdin:  # closed, with the process that started this one
                return
            if ready is listener:
                connection = listener.accept()[0]
                _, streams, _, _ = socket.recv_fds(connection, 1, 2)
                answers = connection.makefile("rw")
                process = _FORK.Process(target=_run, args=(streams, *json.loads(answers.readline())))
                process.start()
                for stream in streams:
                    os.close(stream)
                connection.close()
                running[process.sentinel] = process, answers
                _answer(answers, process.pid)
            else:
                process, answers = running.pop(ready)
                process.join()
                _answer(answers, process.exitcode)


def _answer(answers: TextIO, number: int) -> None:
    with suppress(OSError):  # who has asked may have been killed
        print(number, file=answers, flush=True)


def _run(streams: list[int], script: str, folder: str, environment: dict[str, str]) -> None:
    """In the forked process: as if Python had been started there for the script."""
    for descriptor, stream in enumerate(streams, 1):
        os.dup2(stream, descriptor)
        os.close(stream)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None
    sys.path[:1] = [str(Path(script).parent), *environment["PYTHONPATH"].split(os.pathsep)]
    sys.argv = [script]
    main = sys.modules["__main__"] = ModuleType("__main__")
    main.__file__ = script
    exec(compile(Path(script).read_bytes(), script, "exec"), main.__dict__)


if __name__ == "__main__":
    from numba import njit

    for name in _PRELOADED:
        import_module(name)
    njit("int64(int64)")(lambda number: number)  # loads and sets up its compiler
    gc.freeze()  # so that no collection in a forked process touches, and thereby copies, the memory of this one
    _serve(socket.socket(fileno=int(sys.argv[1])))
