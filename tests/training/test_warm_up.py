"""What the set-up compiles beforehand is what a training on processors would wait for."""

import subprocess
import sys

import pytest
from helpers import REPOSITORY

from drivesplat.training.warm_up import warm_up

LEFT = """
import importlib, pathlib, pkgutil, tempfile
from numba.core.registry import CPUDispatcher
from drivesplat.kernels import numba as package
from drivesplat.training.warm_up import warm_up

with tempfile.TemporaryDirectory() as folder:
    warm_up(pathlib.Path(folder))
for found in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
    for name, kernel in vars(importlib.import_module(found.name)).items():
        if isinstance(kernel, CPUDispatcher) and kernel.stats.cache_path:  # without: kept with its callers
            print(name, len(kernel.signatures))
"""


def test_the_warm_up_trains_to_its_end(tmp_path):
    warm_up(tmp_path)
    assert (tmp_path / "tensorboard").exists()


@pytest.mark.slow
def test_the_warm_up_compiles_every_kernel_of_a_training():
    done = subprocess.run([sys.executable, "-c", LEFT], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    compiled = dict(line.rsplit(" ", 1) for line in done.stdout.splitlines())
    if not compiled:
        pytest.skip("no folder for what is compiled can be written")
    assert len(compiled) > 12
    assert {name: count for name, count in compiled.items() if count == "0"} == {}
