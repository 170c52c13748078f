"""The compute device: what is refused before training, and with which message."""

import importlib.machinery
import importlib.util
import json
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch

from drivesplat.errors import DeviceError
from drivesplat.machine.device import choose_device, device_name, explain_out_of_memory, flush_denormals
from drivesplat.machine.gsplat_build.installed import RECORD, versions
from drivesplat.settings.device import DeviceSettings


@pytest.fixture
def no_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.fixture
def a_gpu(monkeypatch):
    """A GPU with 10 of 24 GB free, and a gsplat compiled for it."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (10_000_000_000, 24_000_000_000))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda *_: "NVIDIA RTX 4090")
    backend = ModuleType("gsplat.cuda._backend")
    backend._C = object()
    monkeypatch.setitem(sys.modules, backend.__name__, backend)


def refusal(kind: str = "auto", **settings: float) -> str:
    """The message with which a device is refused."""
    with pytest.raises(DeviceError) as error:
        choose_device(DeviceSettings(kind=kind, **settings))
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("kind", "cuda", "hip", "expected"),
    [
        ("auto", None, None, "built without GPU support"),
        ("cuda", "13.0", None, "finds no GPU"),
        ("auto", None, "6.4", "finds no GPU"),
    ],
)
def test_without_a_gpu_torch_or_the_driver_is_named_and_the_cpu_not_used_silently(
    no_gpu, monkeypatch, kind, cuda, hip, expected
):
    monkeypatch.setattr(torch.version, "cuda", cuda)
    monkeypatch.setattr(torch.version, "hip", hip)
    message = refusal(kind)
    assert all(part in message for part in ("no usable GPU", "device: cpu", expected, torch.__version__))


def test_device_cpu_selects_the_cpu(no_gpu):
    assert choose_device(DeviceSettings.model_validate("cpu")) == torch.device("cpu")
    assert device_name(torch.device("cpu")).startswith("cpu ("), "with its architecture"


def test_denormal_numbers_are_zero_once_they_are_flushed():
    torch.set_flush_denormal(False)
    small = torch.tensor([1e-39])
    try:
        assert float(small * 0.5) > 0.0
        flush_denormals()
        assert float(small * 0.5) == 0.0
    finally:
        torch.set_flush_denormal(False)


def test_a_gpu_is_used_if_it_has_enough_free_memory(a_gpu, caplog):
    for kind in ("auto", "cuda", "any"):
        assert choose_device(DeviceSettings(kind=kind, min_free_gb=1.0)) == torch.device("cuda")
    assert choose_device(DeviceSettings(min_free_gb=500), min_free_gb=0.0) == torch.device("cuda"), "less by a stage"
    message = refusal(min_free_gb=12.5)
    named = ("RTX 4090", "10.0 GB", "12.5", "device.min_free_gb", "train.cap_max")
    assert all(part in message for part in named) and not caplog.records
    assert choose_device(DeviceSettings(kind="any", min_free_gb=12.5)) == torch.device("cpu")
    assert "using the CPU" in caplog.text and "12.5" in caplog.text


@pytest.mark.parametrize(("max_gb", "fraction"), [(None, None), (6.0, 0.25), (48.0, 1.0)])
def test_the_memory_of_a_job_is_limited(a_gpu, monkeypatch, max_gb, fraction):
    limits = []
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda *_: SimpleNamespace(total_memory=24_000_000_000))
    monkeypatch.setattr(torch.cuda, "set_per_process_memory_fraction", limits.append)
    choose_device(DeviceSettings(max_gb=max_gb, min_free_gb=1.0))
    assert limits == ([] if fraction is None else [fraction])


def test_gsplat_that_cannot_be_imported_or_compiled_is_reported_with_what_to_do(a_gpu, monkeypatch):
    sys.modules["gsplat.cuda._backend"]._C = None
    message = refusal()
    assert "nvcc" in message and "toolkit" in message and "device: cpu" in message
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", None)
    message = refusal()
    assert "gsplat cannot be loaded" in message and "reinstall" in message and "device: cpu" in message


@pytest.fixture
def gsplat_package(a_gpu, monkeypatch, tmp_path):
    """The GPU of `a_gpu`, of compute capability 8.9, and a gsplat of sources that compiles when imported: Python
    modules replace its compiled ones."""
    for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda *_: (8, 9))
    monkeypatch.syspath_prepend(str(tmp_path))
    package = tmp_path / "gsplat"
    (package / "cuda").mkdir(parents=True)
    for folder in (package, package / "cuda"):
        (folder / "__init__.py").touch()
    (package / "cuda/_backend.py").write_text("raise SystemExit('compiles for minutes')")
    real = importlib.machinery.FileFinder.find_spec

    def sources_first(self, name, target=None):
        if name == "gsplat.csrc":
            return importlib.util.spec_from_file_location(name, Path(self.path) / "csrc.py")
        return real(self, name, target)

    monkeypatch.setattr(importlib.machinery.FileFinder, "find_spec", sources_first)
    yield package
    for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
        del sys.modules[name]


def compiled_into(package: Path, archs: list[str] | None, code: str = "") -> None:
    """Kernels in the package: those of a wheel, or where `archs` are given those of the set-up."""
    (package / f"csrc{EXTENSION_SUFFIXES[0]}").touch()
    (package / "csrc.py").write_text(code)  # found where the empty file cannot be loaded
    (package / "cuda/_backend.py").write_text("from gsplat import csrc as _C")
    if archs:
        (package / RECORD).write_text(json.dumps({"archs": archs, "versions": versions()}))


def test_a_run_does_not_start_compiling_gsplat(gsplat_package):
    message = refusal()
    assert "not compiled" in message and "make setup" in message and "make doctor" in message
    assert f"{sys.executable} -m drivesplat.machine.gsplat_build" in message and "device: cpu" in message


def test_gsplat_compiled_for_this_gpu_is_used(gsplat_package):
    compiled_into(gsplat_package, ["7.5", "8.6"])
    assert choose_device(DeviceSettings()) == torch.device("cuda")


@pytest.mark.parametrize(
    ("archs", "code", "words"),
    [
        (["7.5"], "", ("RTX 4090", "8.9", 'GSPLAT_ARCHS="7.5;8.9" make setup')),
        (
            None,
            "raise ImportError('undefined symbol: _ZN3c10')",
            ("gsplat cannot be loaded", "undefined symbol", "make doctor"),
        ),
    ],
)
def test_gsplat_compiled_for_another_gpu_or_torch_is_refused_and_not_recompiled(gsplat_package, archs, code, words):
    compiled_into(gsplat_package, archs, code)
    message = refusal()
    assert all(word in message for word in words), message


def test_on_amd_gsplat_loads_its_own_way(gsplat_package, monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", None)
    (gsplat_package / "cuda/_backend.py").write_text("_C = object()")
    assert choose_device(DeviceSettings()) == torch.device("cuda")


def test_out_of_memory_is_reported_with_what_to_do():
    count = 1
    with pytest.raises(DeviceError) as error, explain_out_of_memory(lambda: count):
        count = 1_234_567
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")
    message = str(error.value)
    assert "1,234,567 Gaussians" in message and "peak" in message and "train.cap_max" in message
    assert "\n" not in message
