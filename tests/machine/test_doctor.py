"""The findings of the doctor for given facts."""

import os
import subprocess
import sys
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
from helpers import REPOSITORY

from drivesplat.io.free_disk import free_bytes
from drivesplat.machine.doctor import facts as facts_module
from drivesplat.machine.doctor.__main__ import main
from drivesplat.machine.doctor.checks import examine
from drivesplat.machine.doctor.facts import Dataset, Facts, Gsplat, Torch, gather
from drivesplat.machine.doctor.torch_builds import Gpu, advice, at_least, best_build, generation, read_gpus
from drivesplat.machine.gsplat_build.toolkit import Toolkit
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


def only(facts: Facts, topic: str) -> tuple[str, str]:
    """Level and text of the one finding on a topic."""
    (finding,) = of(facts, topic)
    return finding


def levels(facts: Facts) -> set[str]:
    return {finding.level for finding in examine(facts)}


def test_a_machine_without_problems_has_only_ok_findings():
    assert levels(WORKSTATION) == {"ok"}


def test_many_uncached_modules_are_reported():
    level, text = only(replace(WORKSTATION, uncached_modules=1240), "bytecode")
    assert level == "note" and "1,240 modules" in text and "PYTHONPYCACHEPREFIX" in text
    assert not of(replace(WORKSTATION, uncached_modules=30), "bytecode")


@pytest.mark.slow
def test_modules_without_cached_bytecode_are_counted(tmp_path):
    script = (
        "import sys, json, http.server; from drivesplat.machine.doctor.facts import _uncached_modules as f; print(f())"
    )
    counts = []
    for keeps in ({"PYTHONDONTWRITEBYTECODE": "1"}, {}, {"PYTHONDONTWRITEBYTECODE": "1"}):
        clean = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        environment = {**clean, "PYTHONPYCACHEPREFIX": str(tmp_path), **keeps}
        run = [sys.executable, "-c", script]
        counts.append(int(subprocess.run(run, env=environment, cwd=REPOSITORY, capture_output=True, check=True).stdout))
    assert counts[0] > 100 and counts[1:] == [0, 0], "none cached; all written; all cached before"


def test_no_gpu_is_a_note_with_its_consequence():
    level, text = only(LAPTOP, "GPU")
    assert level == "note" and "CPU demo runs" in text and "device: cpu" in text
    assert "fix" not in levels(LAPTOP)


def test_a_driver_that_does_not_answer_is_reported():
    level, text = only(replace(LAPTOP, gpu_problem="nvidia-smi fails: couldn't communicate"), "GPU")
    assert level == "note" and "couldn't communicate" in text and "driver" in text


def test_an_old_driver_is_reported_with_its_version_and_the_fitting_build():
    gpu = replace(GOOD_GPU, driver="550.120")
    facts = replace(LAPTOP, gpus=(gpu,))
    level, text = only(facts, "torch")
    assert level == "fix" and "550.120" in text and "580" in text and "TORCH_CUDA=cu126 make setup" in text
    level, text = of(facts, "GPU")[-1]
    assert level == "note" and text.startswith("torch cannot use it (see torch above)")


def test_a_pascal_gpu_is_too_old_for_every_build():
    facts = replace(LAPTOP, gpus=(Gpu("NVIDIA GeForce GTX 1080", "580.65.06", (6, 1)),))
    level, text = only(facts, "torch")
    assert level == "note" and "Pascal" in text and "too old for gsplat" in text and "TORCH_CUDA=cpu" in text


def test_a_volta_gpu_is_advised_the_older_build():
    level, text = only(replace(LAPTOP, gpus=(Gpu("Tesla V100", "580.65.06", (7, 0)),)), "torch")
    assert level == "fix" and "TORCH_CUDA=cu126 make setup" in text


def test_a_cpu_build_with_a_usable_gpu_is_reported():
    facts = replace(LAPTOP, gpus=(GOOD_GPU,), torch=Torch("2.11.0+cpu"))
    level, text = only(facts, "torch")
    assert level == "note" and "RTX 4090" in text and "TORCH_CUDA=cu130 make setup" in text
    assert only(replace(LAPTOP, torch=Torch("2.11.0+cpu")), "torch")[0] == "ok"


def test_a_gpu_that_torch_does_not_find_is_to_be_fixed():
    findings = of(replace(LAPTOP, gpus=(GOOD_GPU,)), "GPU")
    assert findings[-1][0] == "fix" and "CUDA_VISIBLE_DEVICES" in findings[-1][1]


@pytest.mark.parametrize(
    "toolkit",
    [
        None,
        Toolkit(Path("/usr/local/cuda"), "13.0", "installed"),
        Toolkit(Path("/usr/local/cuda"), "12.4", "installed"),
    ],
)
def test_with_uncompiled_gsplat_the_doctor_says_that_training_will_be_refused(toolkit):
    facts = replace(WORKSTATION, gsplat=Gsplat("1.5.3"), toolkit=toolkit)
    level, text = only(facts, "gsplat")
    assert level == "fix" and "refused" in text and "make setup" in text
    assert ("nvcc" in text) is (toolkit is None or toolkit.release == "12.4")


def test_without_nvcc_for_cuda_12_a_toolkit_has_to_be_installed():
    torch = replace(WORKSTATION.torch, cuda="12.6", version="2.11.0+cu126")
    facts = replace(WORKSTATION, torch=torch, gsplat=Gsplat("1.5.3"))
    assert "CUDA_HOME" in only(facts, "gsplat")[1]
    assert "docs/installation.md" in only(facts, "CUDA toolkit")[1]


def test_without_a_cpp_compiler_the_package_to_install_is_named():
    facts = replace(WORKSTATION, gsplat=Gsplat("1.5.3"), compile_problem="no C++ compiler: sudo apt-get install g++")
    level, text = only(facts, "C++ compiler")
    assert level == "fix" and "apt-get install g++" in text
    assert of(replace(facts, gsplat=COMPILED), "C++ compiler") == [], "irrelevant once compiled"


def test_gsplat_compiled_for_another_gpu_names_both_and_the_command():
    facts = replace(WORKSTATION, gsplat=replace(COMPILED, archs=("7.5",)))
    level, text = only(facts, "gsplat")
    assert level == "fix" and "7.5" in text and 'GSPLAT_ARCHS="7.5;8.9" make setup' in text


def test_gsplat_of_a_prebuilt_wheel_is_fine():
    assert only(replace(WORKSTATION, gsplat=replace(COMPILED, archs=None)), "gsplat")[0] == "ok"


@pytest.mark.parametrize(
    "facts",
    [
        replace(WORKSTATION, gsplat=None),
        replace(WORKSTATION, gsplat=replace(COMPILED, problem="ImportError: undefined symbol")),
    ],
)
def test_gsplat_that_cannot_be_imported_is_to_be_fixed(facts):
    level, text = only(facts, "gsplat")
    assert (
        level == "fix" and "make setup" in text and (facts.gsplat.problem if facts.gsplat else "not installed") in text
    )


def test_a_triton_problem_is_a_note_with_the_packages_to_install():
    assert only(WORKSTATION, "Triton")[0] == "ok" and not of(LAPTOP, "Triton")
    level, text = only(replace(WORKSTATION, triton_problem="Failed to find C compiler."), "Triton")
    assert level == "note" and "Failed to find C compiler." in text and "gcc" in text and "python3-dev" in text


def test_torch_that_cannot_be_imported_is_to_be_fixed():
    facts = replace(WORKSTATION, torch=None, torch_problem="ImportError: libcudart.so.13")
    assert only(facts, "torch")[0] == "fix" and "libcudart.so.13" in only(facts, "torch")[1]


def test_too_little_free_memory_is_compared_with_the_config():
    torch = replace(WORKSTATION.torch, free_gb=5.0)
    finding = of(replace(WORKSTATION, torch=torch), "GPU")[-1]
    assert finding[0] == "fix" and "5.0 GB" in finding[1] and "device.min_free_gb asks for 8" in finding[1]
    enough = replace(WORKSTATION, torch=torch, config=load({"device": {"min_free_gb": 5}}))
    assert levels(enough) == {"ok"}


def test_amd_is_recognised_from_torch_only():
    torch = Torch(
        "2.8.0+rocm6.4", hip="6.4", gpu="AMD Instinct MI300X", capability=(9, 4), free_gb=190.0, total_gb=192.0
    )
    facts = replace(WORKSTATION, gpus=(), torch=torch, gsplat=Gsplat("1.5.3b2"))
    assert levels(facts) == {"ok"}
    assert "ROCm 6.4" in only(facts, "torch")[1] and "MI300X" in only(facts, "GPU")[1]
    assert "AMD" in only(facts, "gsplat")[1] and of(facts, "CUDA toolkit") == []
    without = replace(facts, torch=Torch("2.8.0+rocm6.4", hip="6.4"))
    assert only(without, "GPU")[0] == "note" and "docs/amd.md" in only(without, "GPU")[1]


def test_a_missing_dataset_is_a_note_with_its_place_and_source():
    problem = "nuScenes v1.0-mini not found: there is no folder /data; download it from https://www.nuscenes.org"
    level, text = only(replace(LAPTOP, datasets=(Dataset("nuscenes", problem=problem),)), "dataset nuscenes")
    assert level == "note" and problem in text and "make demo" in text


def test_a_dataset_whose_reader_lacks_a_package_is_to_be_fixed(monkeypatch):
    monkeypatch.setattr("drivesplat.readers.nuscenes.layout.find_spec", lambda name: None)
    config = load({"datasets": {
        "one": {"dataroot": "/no", "scenes": ["a"]}, "two": {"reader": "drive", "dataroot": "/no", "scenes": ["b"]}
    }})  # fmt: skip
    facts = replace(LAPTOP, datasets=facts_module._datasets(config))
    assert only(facts, "dataset one")[0] == "fix" and "pip install --no-deps" in only(facts, "dataset one")[1]
    assert only(facts, "dataset two")[0] == "note"


def test_a_generated_dataset_may_be_missing():
    level, text = only(replace(LAPTOP, datasets=(Dataset("demo", problem="none", generated=True),)), "dataset demo")
    assert level == "ok" and "generates" in text


def test_a_missing_backbone_says_that_lpips_will_be_null():
    level, text = only(replace(LAPTOP, backbone_sha256=None), "LPIPS")
    assert level == "note" and "null" in text and "resources/lpips/alexnet.pth" in text and "https://" in text


def test_a_failed_backbone_download_is_reported_with_the_reason_of_the_run():
    reason = "the AlexNet backbone could not be fetched from https://x (no route); put the file at y yourself"
    level, text = only(replace(LAPTOP, backbone_sha256=None, backbone_failure=reason), "LPIPS")
    assert level == "note" and reason in text and "null" in text


def test_a_corrupt_backbone_is_to_be_fixed():
    level, text = only(replace(LAPTOP, backbone_sha256="ab" * 32), "LPIPS")
    assert level == "fix" and "abab" in text and "7be5be79" in text and "null" in text


def test_lpips_switched_off_needs_no_backbone():
    facts = replace(LAPTOP, config=load({"lpips": {"enabled": False}}), backbone_sha256=None)
    assert only(facts, "LPIPS")[0] == "ok"


@pytest.mark.parametrize(("free", "level"), [(0.4, "fix"), (5.0, "note"), (50.0, "ok")])
def test_low_disk_space_is_reported_by_its_severity(free, level):
    assert only(replace(LAPTOP, disk_gb={"results": free}), "disk")[0] == level


def test_other_problems_are_to_be_fixed():
    broken = replace(LAPTOP, config=None, config_problem="'trian' is not a setting", ffmpeg=None, venv_outdated=True)
    for topic in ("config", "ffmpeg", "Python"):
        assert only(broken, topic)[0] == "fix"
    assert only(replace(LAPTOP, python=(3, 14)), "Python")[0] == "note"


# Gathering facts.


def test_the_config_is_read_with_presets_merged(tmp_path):
    preset = tmp_path / "preset.yaml"
    preset.write_text("device: {min_free_gb: 3}\nresults_dir: elsewhere\n")
    found = gather(REPOSITORY, [REPOSITORY / "config.yaml", preset])
    assert found.config.device.min_free_gb == 3 and set(found.disk_gb) == {"elsewhere", "resources"}
    assert found.torch.version and found.gsplat.version and found.ffmpeg
    assert examine(found)


def test_a_wrong_config_is_a_finding_not_a_crash(tmp_path):
    (tmp_path / "bad.yaml").write_text("trian: 1\n")
    assert "trian" in facts_module._config([tmp_path / "bad.yaml"])[1]
    assert "absent.yaml" in facts_module._config([tmp_path / "absent.yaml"])[1]


def test_datasets_are_searched_in_the_folders_of_the_config(tiny_root, tmp_path):
    config = load({"datasets": {
        "tiny": {"dataroot": str(tiny_root), "scenes": ["0001"]}, "gone": {"dataroot": str(tmp_path / "no")}
    }})  # fmt: skip
    tiny, gone = facts_module._datasets(config)
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


def test_free_disk_of_a_missing_folder_is_that_of_its_nearest_parent(tmp_path):
    assert free_bytes(tmp_path / "not" / "yet") == pytest.approx(free_bytes(tmp_path), rel=0.1)


@pytest.mark.parametrize(("facts", "status"), [(LAPTOP, 0), (replace(LAPTOP, ffmpeg=None), 1)])
def test_the_exit_status_is_1_if_something_is_broken(monkeypatch, capsys, facts, status):
    monkeypatch.setattr(facts_module, "gather", lambda *_: facts)
    monkeypatch.chdir(REPOSITORY)
    assert main([]) == status
    lines = capsys.readouterr().out.splitlines()
    assert all(line.split()[0] in ("ok", "note", "fix") for line in lines[:-2])


def test_a_python_without_the_packages_says_what_to_do():
    doctor = "drivesplat.machine.doctor.__main__"
    code = f"import sys; sys.modules['pydantic'] = None; import {doctor} as d; sys.exit(d.main([]))"
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
    assert problem is None
    assert gpus == [Gpu("NVIDIA RTX A2000", "580.65.06", (8, 6), 6138 * 1024**2 / 1e9, None)]


def test_without_compute_capability_in_nvidia_smi_the_driver_is_still_read():
    old = {"new": (2, 'Field "compute_cap" is not a valid field to query.'), "old": (0, "GTX 980, 470.1, 4096, 4000\n")}
    (gpu,), problem = read_gpus(smi(old))
    assert problem is None and gpu.driver == "470.1" and gpu.capability is None


def test_a_failing_or_empty_nvidia_smi_is_a_problem_and_a_missing_one_is_none():
    failing = (9, "NVIDIA-SMI has failed because it couldn't communicate with the NVIDIA driver.")
    assert "couldn't communicate" in read_gpus(smi({"new": failing, "old": failing}))[1]
    assert read_gpus(smi({"new": (0, "")})) == ([], "nvidia-smi reports no GPU")

    def absent(*_, **__):
        raise FileNotFoundError

    assert read_gpus(absent) == ([], None)


def test_drivers_are_compared_as_numbers():
    assert at_least("580.65.06", "580") and at_least("1000.1", "580") and at_least("525.60.13", "525.60.13")
    assert not at_least("525.60.11", "525.60.13") and not at_least("99.9", "525.60.13")


@pytest.mark.parametrize(
    ("capability", "driver", "build"),
    [
        ((8, 9), "580.65", "cu130"),
        ((7, 5), "610.1", "cu130"),
        ((12, 0), "580.65", "cu130"),
        ((8, 6), "560.35", "cu126"),
        ((7, 5), "525.60.13", "cu126"),
        ((9, 0), "550.1", "cu128"),
        ((12, 0), "570.1", "cu128"),
        ((7, 0), "580.65", "cu126"),
        ((8, 6), "470.1", None),
        ((6, 1), "580.65", None),
        ((5, 2), "580.65", None),
        (None, "580.65", "cu130"),
        (None, "550.1", "cu126"),
    ],
)
def test_the_best_build_for_gpu_and_driver(capability, driver, build):
    gpu = Gpu("gpu", driver, capability)
    assert best_build(gpu) == build
    if build is not None:
        assert advice([gpu], build) is None
        if build != "cu130":
            assert f"TORCH_CUDA={build} make setup" in advice([gpu], "cu130")
    else:
        assert "TORCH_CUDA=cpu make setup" in advice([gpu], "cu130")


def test_one_usable_gpu_among_others_suffices():
    old = Gpu("GTX 1080", "580.65", (6, 1))
    assert advice([old, GOOD_GPU], "cu130") is None
    assert advice([old], "cpu") is None and advice([], "cu130") is None


def test_a_build_too_old_for_a_new_gpu_is_reported():
    assert "TORCH_CUDA=cu130" in advice([Gpu("RTX 5090", "580.65", (12, 0))], "cu126")


def test_generations_are_named():
    assert [generation(c) for c in [(5, 2), (6, 1), (7, 0), (7, 5), (8, 6), (8, 9), (9, 0), (12, 0)]] == [
        "Maxwell", "Pascal", "Volta", "Turing", "Ampere", "Ada", "Hopper", "Blackwell",
    ]  # fmt: skip
