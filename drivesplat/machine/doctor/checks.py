"""Findings from facts, one line each: what a fact means and what to do about it. Pure functions."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

from drivesplat.machine.compute_capability import MIN_CAPABILITY, covers, dotted
from drivesplat.machine.doctor.facts import Facts
from drivesplat.machine.doctor.torch_builds import BUILDS, advice
from drivesplat.machine.gsplat_build.toolkit import FROM_PYPI_SINCE, same_major
from drivesplat.settings.evaluate import BACKBONE, LpipsSettings

MIN_DISK_GB, AMPLE_DISK_GB = 1.0, 10.0
MAX_UNCACHED_MODULES = 200
"""They take a few tenths of a second to compile; torch has more than a thousand modules."""


@dataclass(frozen=True)
class Finding:
    """A line of the doctor: `ok`, `note` (works with a restriction) or `fix` (broken, with what to do)."""

    level: Literal["ok", "note", "fix"]
    topic: str
    text: str


ok, note, fix = (partial(Finding, level) for level in ("ok", "note", "fix"))


def examine(facts: Facts) -> list[Finding]:
    """All findings, in the order of their dependencies."""
    checks = (python, bytecode, torch_build, gpu, gsplat, compiler, triton, config, datasets, disk, backbone, ffmpeg)
    return [finding for check in checks for finding in check(facts)]


def python(facts: Facts) -> Iterator[Finding]:
    """The interpreter, and whether its packages are the required ones."""
    version = ".".join(map(str, facts.python))
    found = f"{version} ({facts.executable})"
    if not (3, 11) <= facts.python <= (3, 13):
        yield note("Python", f"{found}: tested with 3.11 to 3.13; PYTHON=python3.11 make setup")
    elif facts.venv_outdated:
        yield fix("Python", ".venv was made from other requirements than the present ones: run make setup")
    else:
        yield ok("Python", found)


def bytecode(facts: Facts) -> Iterator[Finding]:
    """Whether every job compiles its modules again."""
    if facts.uncached_modules > MAX_UNCACHED_MODULES:
        text = f"every job compiles {facts.uncached_modules:,} modules, which takes seconds: "
        text += "unset PYTHONDONTWRITEBYTECODE, or, if the packages are read-only, set PYTHONPYCACHEPREFIX to a "
        yield note("bytecode", text + "writable folder")


def torch_build(facts: Facts) -> Iterator[Finding]:
    """The build of torch, and whether it fits the GPUs reported by nvidia-smi."""
    torch = facts.torch
    if torch is None:
        yield fix("torch", f"cannot be imported ({facts.torch_problem}): run make setup")
    elif not torch.cuda and not torch.hip:
        if any(gpu.runs_gsplat for gpu in facts.gpus):
            text = f"{torch.version} is built for the CPU and ignores {facts.gpus[0].name}: "
            yield note("torch", text + "TORCH_CUDA=cu130 make setup installs the GPU build")
        else:
            yield ok("torch", f"{torch.version}, for the CPU only")
    else:
        found = f"{torch.version} for " + (f"CUDA {torch.cuda}" if torch.cuda else f"ROCm {torch.hip}")
        if facts.torch_problem:
            yield fix("torch", f"{found}: {facts.torch_problem}")
        elif problem := _unfit_build(facts):
            yield (fix if any(gpu.runs_gsplat for gpu in facts.gpus) else note)("torch", problem)
        else:
            yield ok("torch", found)


def _unfit_build(facts: Facts) -> str | None:
    name = next((build.name for build in BUILDS.values() if build.cuda == facts.torch.cuda), None)
    return advice(facts.gpus, name) if name else None


def gpu(facts: Facts) -> Iterator[Finding]:
    """The GPU that torch uses, and whether its free memory suffices for training."""
    for gpu in facts.gpus:
        memory = f", {gpu.total_gb:.1f} GB, {gpu.free_gb:.1f} GB free" if gpu.total_gb and gpu.free_gb else ""
        yield ok("GPU", f"{gpu}, driver {gpu.driver}{memory}" if gpu.capability else f"{gpu}{memory}")
    torch = facts.torch
    if torch is None or torch.gpu is None:
        consequence = "the CPU demo runs; real scenes are refused unless you write device: cpu (very slow)"
        if facts.gpu_problem:
            remedy = "(re)install NVIDIA's driver (Ubuntu: sudo ubuntu-drivers install), then reboot"
            yield note("GPU", f"{facts.gpu_problem}: {remedy}; until then {consequence}")
        elif facts.gpus and torch is not None and (torch.cuda or torch.hip) and _unfit_build(facts) is None:
            yield fix("GPU", "torch finds no GPU: is CUDA_VISIBLE_DEVICES set, or was the driver updated (reboot)?")
        elif facts.gpus:
            yield note("GPU", f"torch cannot use it (see torch above): {consequence}")
        elif torch is not None and torch.hip:
            yield note("GPU", f"this torch for ROCm finds no AMD GPU (see docs/amd.md): {consequence}")
        else:
            yield note("GPU", f"none found: {consequence}")
        return
    if not facts.gpus:
        known = f", compute capability {dotted(torch.capability)}" if torch.cuda and torch.capability else ""
        yield ok("GPU", f"{torch.gpu}{known}, {torch.free_gb:.1f} of {torch.total_gb:.1f} GB free")
    needed = facts.config.device.min_free_gb if facts.config else 0.0
    if torch.free_gb < needed:
        text = f"{torch.gpu} has {torch.free_gb:.1f} GB of free memory, device.min_free_gb asks for {needed:g}: a "
        text += "training will not start; end other programs on it (nvidia-smi lists them), use a smaller preset "
        yield fix("GPU", text + "(presets/8gb.yaml), or lower train.cap_max, images.width and device.min_free_gb")


def gsplat(facts: Facts) -> Iterator[Finding]:
    """gsplat, and whether its kernels are compiled for the GPU."""
    found, torch = facts.gsplat, facts.torch
    if found is None:
        yield fix("gsplat", "not installed: run make setup")
    elif found.problem:
        yield fix("gsplat", f"{found.version} cannot be loaded ({found.problem}): rm -r .venv, then make setup")
    elif torch is None or not torch.cuda:
        where = "its kernels come with AMD's package" if torch and torch.hip else "its kernels are not needed on a CPU"
        yield ok("gsplat", f"{found.version}; {where}")
    elif found.extension is None:
        text = f"{found.version} is not compiled: "
        if torch.capability is None or torch.capability < MIN_CAPABILITY:
            yield note("gsplat", f'{text}no GPU to compile for; for one elsewhere: GSPLAT_ARCHS="8.6" make setup')
            return
        nvcc = f" with a CUDA {torch.cuda} toolkit in CUDA_HOME"
        if facts.toolkit and same_major(facts.toolkit.release, torch.cuda):
            nvcc = ""
        elif int(torch.cuda.split(".")[0]) >= FROM_PYPI_SINCE:
            nvcc = " (installs nvcc, too)"
        text += f"training on the GPU will be refused; run make setup{nvcc}, which takes minutes, once"
        yield fix("gsplat", text)
    else:
        text = f"{found.version}, compiled ({found.extension})"
        text += f" for compute capability {', '.join(found.archs)}" if found.archs else ""
        if not found.archs or torch.capability is None or covers(found.archs, torch.capability):
            yield ok("gsplat", text)
        else:
            has = dotted(torch.capability)
            archs = ";".join([*found.archs, has])
            yield fix("gsplat", f'{text}, but {torch.gpu} has {has}: GSPLAT_ARCHS="{archs}" make setup')


def triton(facts: Facts) -> Iterator[Finding]:
    """Whether Triton kernels, which make training faster, can be compiled for the GPU."""
    if facts.torch is None or facts.torch.gpu is None:
        return
    if facts.triton_problem is None:
        yield ok("Triton", "compiles for this GPU")
    else:
        text = f"cannot be used ({facts.triton_problem}): training takes longer; it needs a C compiler and Python's "
        yield note("Triton", text + "headers (Ubuntu: sudo apt install gcc python3-dev)")


def compiler(facts: Facts) -> Iterator[Finding]:
    """What compiling gsplat needs, until it is compiled."""
    compiled = facts.gsplat is not None and facts.gsplat.extension is not None
    if facts.torch is None or not facts.torch.cuda:
        return
    if facts.toolkit:
        yield ok("CUDA toolkit", f"nvcc {facts.toolkit.release} in {facts.toolkit.home}")
    elif not compiled and int(facts.torch.cuda.split(".")[0]) < FROM_PYPI_SINCE:
        text = f"none; compiling gsplat needs that of CUDA {facts.torch.cuda}: see docs/installation.md"
        yield note("CUDA toolkit", text)
    elif not compiled:
        yield note("CUDA toolkit", "none; make setup installs it from PyPI if gsplat has to be compiled")
    if facts.compile_problem and not compiled:
        yield (note if facts.torch.capability is None else fix)("C++ compiler", facts.compile_problem)
    elif not compiled:
        yield ok("C++ compiler", "found")


def config(facts: Facts) -> Iterator[Finding]:
    if facts.config_problem:
        yield fix("config", facts.config_problem)
    elif facts.config:
        scenes = len(facts.config.scenes)
        yield ok("config", f"{scenes} scenes, methods {', '.join(facts.config.methods)}")


def datasets(facts: Facts) -> Iterator[Finding]:
    """The datasets that the config names."""
    for dataset in facts.datasets:
        topic = f"dataset {dataset.name}"
        if dataset.missing_package:
            yield fix(topic, dataset.missing_package)
        elif dataset.root is not None:
            yield ok(topic, f"found in {dataset.root}")
        elif dataset.generated:
            yield ok(topic, "not there yet: the workflow generates it when needed")
        else:
            yield note(topic, f"{dataset.problem}; make demo does not need it")


def disk(facts: Facts) -> Iterator[Finding]:
    """Free space for results and downloads."""
    for folder, free in facts.disk_gb.items():
        text = f"{free:.1f} GB free for {folder}/"
        if free < MIN_DISK_GB:
            yield fix("disk", f"{text}: jobs will fail; free space, or set results_dir to a folder on another disk")
        elif free < AMPLE_DISK_GB:
            text += ": enough for the demo; a real scene takes up to about 1 GB, ten scenes need about "
            yield note("disk", f"{text}{AMPLE_DISK_GB:g} GB")
        else:
            yield ok("disk", text)


def backbone(facts: Facts) -> Iterator[Finding]:
    """LPIPS's AlexNet."""
    lpips, found = facts.config.lpips if facts.config else LpipsSettings(), facts.backbone_sha256
    if not lpips.enabled:
        yield ok("LPIPS", "disabled (lpips.enabled), so its backbone is not needed")
    elif found is None and facts.backbone_failure:
        yield note("LPIPS", f"LPIPS was null: {facts.backbone_failure}")
    elif found is None:
        text = "no AlexNet backbone yet: the first evaluation downloads it; without network LPIPS is null with that "
        yield note("LPIPS", f"{text}reason, unless you put {lpips.url} at {BACKBONE}")
    elif not found.startswith(lpips.sha256):
        text = f"{BACKBONE} has SHA-256 {found[:16]}…, lpips.sha256 says {lpips.sha256}: LPIPS will be null; "
        yield fix("LPIPS", f"{text}remove the file, or replace it with {lpips.url}")
    else:
        yield ok("LPIPS", f"AlexNet backbone in {BACKBONE}, checksum correct")


def ffmpeg(facts: Facts) -> Iterator[Finding]:
    """The program that writes videos."""
    if facts.ffmpeg:
        yield ok("ffmpeg", facts.ffmpeg)
    else:
        yield fix("ffmpeg", "none: run make setup (installs imageio-ffmpeg), or sudo apt-get install ffmpeg")
