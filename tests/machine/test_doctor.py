"""The findings of the doctor for given facts."""

import os
import subprocess
import sys
from dataclasses import replace
from hashlib import sha256

import pytest
from helpers import REPOSITORY

from drivesplat.machine.doctor import facts as facts_module
from drivesplat.machine.doctor.__main__ import main
from drivesplat.machine.doctor.checks import examine
from drivesplat.machine.doctor.facts import Dataset, Facts, Gsplat, Torch, gather
from drivesplat.machine.doctor.torch_builds import Gpu, advice, best_build, read_gpus
from drivesplat.settings.config import load

GOOD_GPU = Gpu("NVIDIA GeForce RTX 4090", "580.65.06", (8, 9), 25.3, 24.0)
TORCH = Torch("2.11.0+cu130", cuda="13.0")
COMPILED = Gsplat("1.5.3", "/venv/gsplat/csrc.so", ("8.9",))
BACKBONE = "7be5be79" + "0" * 56

LAPTOP = Facts(
    torch=TORCH, gsplat=Gsplat("1.5.3"), config=load({}), datasets=(Dataset("nuscenes", root="/data"),),
    disk_gb={"results": 100.0}, backbone_sha256=BACKBONE, ffmpeg="/bin/ffmpeg",
)  # fmt: skip
"""A machine without a GPU and without problems."""
WORKSTATION = replace(
    LAPTOP,
    gpus=(GOOD_GPU,),
    torch=replace(TORCH, gpu=GOOD_GPU.name, capability=(8, 9), free_gb=24.0, total_gb=25.3),
    gsplat=COMPILED,
)
"""A machine with a GPU and without problems."""


def of(facts: Facts, topic: str) -> list[tuple[str, str]]:
    """Level and text of the findings on a topic."""
    return [(f.level, f.text) for f in examine(facts) if f.topic == topic]


def levels(facts: Facts) -> set[str]:
    return {finding.level for finding in examine(facts)}


def of_gpu(name: str, driver: str, capability: tuple[int, int]) -> Facts:
    """The laptop with a GPU that torch does not see."""
    return replace(LAPTOP, gpus=(Gpu(name, driver, capability),))


CUDA_12 = replace(
    WORKSTATION, torch=replace(WORKSTATION.torch, cuda="12.6", version="2.11.0+cu126"), gsplat=Gsplat("1.5.3")
)
NO_COMPILER = replace(WORKSTATION, compile_problem="no C++ compiler: sudo apt-get install g++")
NO_SCENES = "nuScenes v1.0-mini not found: there is no folder /data; download it from https://www.nuscenes.org"
NO_ROUTE = "the AlexNet backbone could not be fetched from https://x (no route); put the file at y yourself"
BROKEN = replace(LAPTOP, config=None, config_problem="'trian' is not a setting", ffmpeg=None, venv_outdated=True)
FINDINGS = {
    "many uncached modules": (
        replace(WORKSTATION, uncached_modules=1240), "bytecode", "note", ("1,240 modules", "PYTHONPYCACHEPREFIX"),
    ),
    "no GPU": (LAPTOP, "GPU", "note", ("CPU demo runs", "device: cpu")),
    "a driver that does not answer": (
        replace(LAPTOP, gpu_problem="nvidia-smi fails: couldn't communicate"), "GPU", "note", ("couldn't", "driver"),
    ),
    "an old driver": (
        of_gpu("NVIDIA GeForce RTX 4090", "550.120", (8, 9)), "torch", "fix",
        ("550.120", "580", "TORCH_CUDA=cu126 make setup"),
    ),
    "a GPU behind an old driver": (
        of_gpu("NVIDIA GeForce RTX 4090", "550.120", (8, 9)), "GPU", "note", ("torch cannot use it (see torch above)",),
    ),
    "a Pascal GPU": (
        of_gpu("NVIDIA GeForce GTX 1080", "580.65.06", (6, 1)), "torch", "note",
        ("Pascal", "too old for gsplat", "TORCH_CUDA=cpu"),
    ),
    "a Volta GPU": (of_gpu("Tesla V100", "580.65.06", (7, 0)), "torch", "fix", ("TORCH_CUDA=cu126 make setup",)),
    "a CPU build with a GPU": (
        replace(LAPTOP, gpus=(GOOD_GPU,), torch=Torch("2.11.0+cpu")), "torch", "note",
        ("RTX 4090", "TORCH_CUDA=cu130 make setup"),
    ),
    "a CPU build without one": (replace(LAPTOP, torch=Torch("2.11.0+cpu")), "torch", "ok", ()),
    "a GPU that torch does not find": (replace(LAPTOP, gpus=(GOOD_GPU,)), "GPU", "fix", ("CUDA_VISIBLE_DEVICES",)),
    "torch that cannot be imported": (
        replace(WORKSTATION, torch=None, torch_problem="ImportError: libcudart.so.13"), "torch", "fix",
        ("libcudart.so.13",),
    ),
    "too little free memory": (
        replace(WORKSTATION, torch=replace(WORKSTATION.torch, free_gb=5.0)), "GPU", "fix",
        ("5.0 GB", "device.min_free_gb asks for 8"),
    ),
    "gsplat not compiled": (
        replace(WORKSTATION, gsplat=Gsplat("1.5.3")), "gsplat", "fix", ("refused", "make setup", "nvcc"),
    ),
    "nor a toolkit for CUDA 12": (CUDA_12, "gsplat", "fix", ("CUDA_HOME",)),
    "no toolkit for CUDA 12": (CUDA_12, "CUDA toolkit", "note", ("docs/installation.md",)),
    "no C++ compiler": (replace(NO_COMPILER, gsplat=Gsplat("1.5.3")), "C++ compiler", "fix", ("apt-get install g++",)),
    "gsplat for another GPU": (
        replace(WORKSTATION, gsplat=replace(COMPILED, archs=("7.5",))), "gsplat", "fix",
        ('GSPLAT_ARCHS="7.5;8.9" make setup',),
    ),
    "gsplat of a wheel": (replace(WORKSTATION, gsplat=replace(COMPILED, archs=None)), "gsplat", "ok", ()),
    "no gsplat": (replace(WORKSTATION, gsplat=None), "gsplat", "fix", ("make setup", "not installed")),
    "gsplat that does not load": (
        replace(WORKSTATION, gsplat=replace(COMPILED, problem="ImportError: undefined symbol")), "gsplat", "fix",
        ("make setup", "undefined symbol"),
    ),
    "Triton without a compiler": (
        replace(WORKSTATION, triton_problem="Failed to find C compiler."), "Triton", "note",
        ("Failed to find C compiler.", "gcc", "python3-dev"),
    ),
    "no dataset": (
        replace(LAPTOP, datasets=(Dataset("nuscenes", problem=NO_SCENES),)), "dataset nuscenes", "note",
        (NO_SCENES, "make demo"),
    ),
    "a dataset to generate": (
        replace(LAPTOP, datasets=(Dataset("demo", problem="none", generated=True),)), "dataset demo", "ok",
        ("generates",),
    ),
    "no backbone": (
        replace(LAPTOP, backbone_sha256=None), "LPIPS", "note", ("null", "resources/lpips/alexnet.pth", "https://"),
    ),
    "a backbone that was not fetched": (
        replace(LAPTOP, backbone_sha256=None, backbone_failure=NO_ROUTE), "LPIPS", "note", (NO_ROUTE, "null"),
    ),
    "a corrupt backbone": (replace(LAPTOP, backbone_sha256="ab" * 32), "LPIPS", "fix", ("abab", "7be5be79", "null")),
    "LPIPS switched off": (
        replace(LAPTOP, config=load({"lpips": {"enabled": False}}), backbone_sha256=None), "LPIPS", "ok", (),
    ),
    "a full disk": (replace(LAPTOP, disk_gb={"results": 0.4}), "disk", "fix", ()),
    "little disk": (replace(LAPTOP, disk_gb={"results": 5.0}), "disk", "note", ()),
    "a wrong config": (BROKEN, "config", "fix", ("trian",)),
    "no ffmpeg": (BROKEN, "ffmpeg", "fix", ()),
    "other requirements": (BROKEN, "Python", "fix", ()),
    "a newer Python": (replace(LAPTOP, python=(3, 14)), "Python", "note", ()),
}  # fmt: skip


@pytest.mark.parametrize("name", FINDINGS)
def test_a_machine_has_its_finding_with_what_to_do(name):
    facts, topic, level, words = FINDINGS[name]
    *_, (found, text) = of(facts, topic)
    assert found == level and all(word in text for word in words), text


def test_machines_without_problems_have_none_and_no_findings_on_what_they_do_not_need():
    assert levels(WORKSTATION) == {"ok"} and "fix" not in levels(LAPTOP)
    assert not of(replace(WORKSTATION, uncached_modules=30), "bytecode") and not of(LAPTOP, "Triton")
    assert of(NO_COMPILER, "C++ compiler") == [], "irrelevant once compiled"
    enough = replace(WORKSTATION.torch, free_gb=5.0)
    assert levels(replace(WORKSTATION, torch=enough, config=load({"device": {"min_free_gb": 5}}))) == {"ok"}


def test_amd_is_recognised_from_torch_only():
    torch = Torch("2.8.0+rocm6.4", hip="6.4", gpu="AMD MI300X", capability=(9, 4), free_gb=190.0, total_gb=192.0)
    facts = replace(WORKSTATION, gpus=(), torch=torch, gsplat=Gsplat("1.5.3b2"))
    assert levels(facts) == {"ok"} and of(facts, "CUDA toolkit") == []
    for topic, word in (("torch", "ROCm 6.4"), ("GPU", "MI300X"), ("gsplat", "AMD")):
        assert word in of(facts, topic)[0][1]
    ((level, text),) = of(replace(facts, torch=Torch("2.8.0+rocm6.4", hip="6.4")), "GPU")
    assert level == "note" and "docs/amd.md" in text


@pytest.mark.slow
def test_modules_without_cached_bytecode_are_counted(tmp_path):
    script = "import sys, http.server; from drivesplat.machine.doctor.facts import _uncached_modules as f; print(f())"
    run, counts = [sys.executable, "-c", script], []
    for value in ("1", "", "1"):
        environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path), "PYTHONDONTWRITEBYTECODE": value}
        counts.append(int(subprocess.run(run, env=environment, cwd=REPOSITORY, capture_output=True, check=True).stdout))
    assert counts[0] > 100 and counts[1:] == [0, 0], "none cached; all written; all cached before"


# Gathering facts.


def test_the_config_is_read_with_presets_merged(tmp_path):
    preset = tmp_path / "preset.yaml"
    preset.write_text("device: {min_free_gb: 3}\nresults_dir: elsewhere\n")
    found = gather(REPOSITORY, [REPOSITORY / "config.yaml", preset])
    assert found.config.device.min_free_gb == 3 and set(found.disk_gb) == {"elsewhere", "resources"}
    assert found.torch.version and found.gsplat.version and found.ffmpeg
    assert examine(found)


def test_a_wrong_config_is_a_finding_and_datasets_are_searched_in_its_folders(tiny_root, tmp_path):
    (tmp_path / "bad.yaml").write_text("trian: 1\n")
    for name, word in (("bad.yaml", "trian"), ("absent.yaml", "absent.yaml")):
        assert word in facts_module._config([tmp_path / name])[1]
    datasets = {"tiny": {"dataroot": str(tiny_root), "scenes": ["0001"]}, "gone": {"dataroot": str(tmp_path / "no")}}
    tiny, gone = facts_module._datasets(load({"datasets": datasets}))
    assert tiny.root == str(tiny_root) and not tiny.generated
    assert gone.root is None and str(tmp_path / "no") in gone.problem


def test_the_backbone_is_hashed_and_the_last_failure_read(tmp_path):
    assert facts_module._backbone_failure(tmp_path) is None
    folder = tmp_path / "resources/lpips"
    folder.mkdir(parents=True)
    (folder / "alexnet.pth").write_bytes(b"weights")
    (folder / "backbone.json").write_text('{"unavailable": "no route"}')
    found = gather(tmp_path, [])
    assert (found.backbone_sha256, found.backbone_failure) == (sha256(b"weights").hexdigest(), "no route")
    (folder / "backbone.json").write_text("[1")
    assert facts_module._backbone_failure(tmp_path) is None


def test_a_venv_of_other_requirements_is_noticed(tmp_path, monkeypatch):
    for name in facts_module.REQUIREMENTS:
        (tmp_path / name).write_text(f"{name}\n")
    (tmp_path / ".venv").mkdir()
    monkeypatch.setattr(sys, "prefix", str(tmp_path / ".venv"))
    stamp = tmp_path / facts_module.STAMP
    stamp.write_text(sha256(b"requirements.txt\nrequirements-dev.txt\nconstraints.txt\n").hexdigest() + " cu126\n")
    assert not facts_module._venv_outdated(tmp_path)
    stamp.write_text("0" * 64 + "\n")
    assert facts_module._venv_outdated(tmp_path)


def test_the_exit_status_is_1_if_something_is_broken(monkeypatch, capsys):
    monkeypatch.chdir(REPOSITORY)
    for facts, status in ((LAPTOP, 0), (replace(LAPTOP, ffmpeg=None), 1)):
        monkeypatch.setattr(facts_module, "gather", lambda *_, facts=facts: facts)
        assert main([]) == status
        lines = capsys.readouterr().out.splitlines()
        assert all(line.split()[0] in ("ok", "note", "fix") for line in lines[:-2])


def test_a_python_without_the_packages_says_what_to_do():
    doctor = "drivesplat.machine.doctor.__main__"
    absent = "sys.modules |= dict.fromkeys(['numpy', 'pydantic', 'torch', 'yaml'])"
    code = f"import sys; {absent}; import {doctor} as d; sys.exit(d.main([]))"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stdout.startswith("fix") and "make setup" in done.stdout


# GPUs and builds of torch.


def smi(answers: dict[str, tuple[int, str]]):
    """An nvidia-smi that answers by whether compute_cap is asked for."""

    def run(command, **_):
        status, text = answers["new" if "compute_cap" in command[1] else "old"]
        return subprocess.CompletedProcess(command, status, stdout=text, stderr="")

    return run


def test_gpus_are_read_from_nvidia_smi():
    gpus, problem = read_gpus(smi({"new": (0, "NVIDIA RTX A2000, 580.65.06, 6138, [N/A], 8.6\n")}))
    assert (gpus, problem) == ([Gpu("NVIDIA RTX A2000", "580.65.06", (8, 6), 6138 * 1024**2 / 1e9, None)], None)
    old = {"new": (2, 'Field "compute_cap" is not a valid field to query.'), "old": (0, "GTX 980, 470.1, 4096, 4000\n")}
    (gpu,), problem = read_gpus(smi(old))
    assert (problem, gpu.driver, gpu.capability) == (None, "470.1", None), "known without compute capability"
    failing = (9, "NVIDIA-SMI has failed because it couldn't communicate with the NVIDIA driver.")
    assert "couldn't communicate" in read_gpus(smi({"new": failing, "old": failing}))[1]
    assert read_gpus(smi({"new": (0, "")})) == ([], "nvidia-smi reports no GPU")

    def absent(*_, **__):
        raise FileNotFoundError

    assert read_gpus(absent) == ([], None)


def test_the_best_build_for_gpu_and_driver():
    for capability, driver, build in (
        ((8, 9), "580.65", "cu130"), ((12, 0), "610.1", "cu130"), ((7, 5), "525.60.13", "cu126"),
        ((9, 0), "550.1", "cu128"), ((12, 0), "570.1", "cu128"), ((7, 0), "580.65", "cu126"), ((8, 6), "470.1", None),
        ((6, 1), "580.65", None), (None, "580.65", "cu130"), (None, "550.1", "cu126"), ((8, 6), "560.35", "cu126"),
    ):  # fmt: skip
        gpu = Gpu("gpu", driver, capability)
        assert best_build(gpu) == build, gpu
        assert build is None or advice([gpu], build) is None
        if build != "cu130":
            assert f"TORCH_CUDA={build or 'cpu'} make setup" in advice([gpu], "cu130"), gpu


def test_one_usable_gpu_among_others_suffices_and_a_build_may_be_too_old():
    old = Gpu("GTX 1080", "580.65", (6, 1))
    assert advice([old, GOOD_GPU], "cu130") is None
    assert advice([old], "cpu") is None and advice([], "cu130") is None
    assert "TORCH_CUDA=cu130" in advice([Gpu("RTX 5090", "580.65", (12, 0))], "cu126")
