"""`drivesplat setup`: what it compiles, on which machines, and that it does so once. Nothing is compiled here."""

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
import yaml

from drivesplat.cli import setup
from drivesplat.cli.__main__ import main
from drivesplat.kernels import triton_support
from drivesplat.kernels.cuda import compiled
from drivesplat.settings.config import for_scene, load, merged


class Runs:
    """Stands for Snakemake: the arguments of each run, which end with a `status`."""

    def __init__(self, status: int = 0):
        self.status, self.given = status, []

    def __call__(self, arguments: Sequence[str], folder: Path) -> int:
        assert folder.is_dir() and not any(folder.iterdir())
        self.given.append(list(arguments))
        return self.status


@pytest.fixture
def cards(monkeypatch, tmp_path):
    """A machine with two GPUs, one of an older kind, for which Triton compiles."""
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path / "triton"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda number: [(9, 0), (8, 6)][number])
    monkeypatch.setattr(triton_support, "compiles", lambda: True)


def test_the_jobs_of_a_tiny_drive_compile_the_kernels_once_for_each_kind_of_card(cards, monkeypatch, capsys):
    pytest.importorskip("triton", reason="Triton is not there for this system")
    runs = Runs()
    assert setup.compile_on_cards(runs) == 0 and setup.compile_on_cards(runs) == 0
    (given,) = runs.given
    assert given[given.index("--resources") + 1] == f"gpu={2 * setup.JOBS_PER_CARD}"
    assert given[given.index("--") + 1 :] == list(setup.TARGETS)
    assert capsys.readouterr().err.count("compiling the kernels for this card") == 1
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda number: (12, 0))
    assert setup.compile_on_cards(runs) == 0 and len(runs.given) == 2, "another card"


def test_kernels_that_were_not_compiled_are_tried_again(cards, capsys):
    pytest.importorskip("triton", reason="Triton is not there for this system")
    assert setup.compile_on_cards(Runs(status=1)) == 1
    assert "the first jobs compile the rest" in capsys.readouterr().err
    again = Runs()
    assert setup.compile_on_cards(again) == 0 and len(again.given) == 1


@pytest.mark.parametrize("missing", ["card", "triton"])
def test_nothing_is_run_without_a_card_for_which_triton_compiles(missing, cards, monkeypatch):
    if missing == "card":
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    else:
        monkeypatch.setattr(triton_support, "compiles", lambda: False)
    runs = Runs()
    assert setup.compile_on_cards(runs) == 0 and not runs.given


def test_the_drive_of_the_warm_up_trains_the_methods_of_the_workflow_on_a_card():
    """As many jobs share a card as Snakemake is told."""
    config = warm_up_config()
    assert {"vanilla", "street", "street_lidar"} <= set(config.methods) and config.batch_scenes == ["demo"]
    assert config.device.kind == "cuda" and config.device.jobs_per_card == setup.JOBS_PER_CARD


def test_the_warm_up_trains_every_kind_of_image_that_has_kernels_of_its_own():
    """With and without a rolling shutter, LiDAR depth and limited scales: those of recorded drives and of the demo."""
    config = warm_up_config()
    assert config.datasets["demo"].world.readout_s > 0
    kinds = set()
    for method in config.methods:
        train = for_scene(config, "demo", method).train
        kinds.add((train.rolling_shutter, train.depth_weight > 0, train.max_scale > 0))
    assert {(True, True, False), (False, True, False), (False, False, False), (False, True, True)} <= kinds
    shipped = load(shipped_values())
    assert shipped.train.max_scale == 0 < for_scene(shipped, "demo", "street").train.max_scale


def shipped_values():
    return yaml.safe_load((setup.WORKFLOW / "config.yaml").read_text())


def warm_up_config():
    values = shipped_values()
    for preset in setup.PRESETS:
        values = merged(values, yaml.safe_load(Path(preset).read_text()))
    return load(values)


def test_arch_compiles_every_program_for_cards_that_are_elsewhere(monkeypatch, tmp_path, capsys):
    asked = []

    def compile_one(program: compiled.Program, channels: int, length: int, capability: str) -> bytes:
        asked.append((program.name, channels, capability))
        return b"binary"

    monkeypatch.setattr(compiled, "compiled", compile_one)
    monkeypatch.setattr(compiled, "cache_folder", lambda *_: tmp_path)
    assert main(["setup", "--arch", "8.6;9.0+PTX, 8.6"]) == 0
    count = sum(len(numbers) for numbers in compiled.USED.values())
    assert len(asked) == 2 * count == len(set(asked)) == len(list(tmp_path.iterdir()))
    assert {capability for *_, capability in asked} == {"86", "90"}
    assert capsys.readouterr().out.count(f"{count} CUDA C++ programs") == 3


@pytest.mark.parametrize("given", ["hopper", "9", "8.6,"])
def test_arch_refuses_what_is_no_compute_capability(given, monkeypatch, capsys):
    monkeypatch.setattr(compiled, "compile_ahead", lambda capability: 1)
    valid = given == "8.6,"
    assert main(["setup", "--arch", given]) == (0 if valid else 1)
    assert ("is no compute capability" in capsys.readouterr().err) != valid


def test_a_compiler_that_fails_is_an_error_in_one_sentence(monkeypatch, tmp_path, capsys):
    def fail(*_: object) -> bytes:
        raise RuntimeError("NVRTC does not take programs")

    monkeypatch.setattr(compiled, "compiled", fail)
    monkeypatch.setattr(compiled, "cache_folder", lambda *_: tmp_path)
    assert main(["setup", "--arch", "9.0"]) == 1
    assert capsys.readouterr().err.startswith("drivesplat: CUDA kernels cannot be compiled for compute capability 90")
