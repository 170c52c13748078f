"""From facts to findings: what each means and what to do about it, one line each. Pure functions."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from drivesplat.machine.doctor.facts import Dataset, Facts, Torch, lpips_of
from drivesplat.machine.doctor.torch_builds import BUILDS, OLDEST_FOR_GSPLAT, advice, dotted
from drivesplat.machine.gsplat_build.installed import covers
from drivesplat.machine.gsplat_build.toolkit import FROM_PYPI_SINCE, same_major
from drivesplat.settings.evaluate import BACKBONE

LOWEST_DISK_GB, ROOMY_DISK_GB = 1.0, 10.0
FEW_MODULES = 200
"""So many take a few tenths of a second to compile; torch has more than a thousand."""


@dataclass(frozen=True)
class Finding:
    """One line of the doctor: `ok`, `note` (works without, with a consequence) or `fix` (broken, with what to do)."""

    level: Literal["ok", "note", "fix"]
    topic: str
    text: str


def examine(facts: Facts) -> list[Finding]:
    """All findings, in the order in which things depend on each other."""
    checks = (python, bytecode, torch_build, gpu, gsplat, compiler, triton, config, datasets, disk, backbone, ffmpeg)
    return [finding for check in checks for finding in check(facts)]


def python(facts: Facts) -> Iterator[Finding]:
    """The interpreter, and whether its packages are those required now."""
    version = ".".join(map(str, facts.python))
    if not (3, 11) <= facts.python <= (3, 12):
        yield Finding(
            "note", "Python", f"{version} ({facts.executable}): tested with 3.11 and 3.12; PYTHON=python3.11 make setup"
        )
    elif facts.outdated:
        yield Finding("fix", "Python", ".venv was made from other requirements than the present ones: run make setup")
    else:
        yield Finding("ok", "Python", f"{version} ({facts.executable})")


def bytecode(facts: Facts) -> Iterator[Finding]:
    """Whether every job compiles its packages' Python anew; nothing to say where it does not."""
    if facts.read_as_source > FEW_MODULES:
        yield Finding(
            "note", "bytecode", f"Python compiles {facts.read_as_source:,} modules anew in every job, for seconds: "
            "unset PYTHONDONTWRITEBYTECODE, or, where packages cannot be written to, set PYTHONPYCACHEPREFIX to a "
            "folder that can",
        )  # fmt: skip


def torch_build(facts: Facts) -> Iterator[Finding]:
    """The build of torch, against the cards that nvidia-smi knows."""
    torch = facts.torch
    if torch is None:
        yield Finding("fix", "torch", f"cannot be imported ({facts.torch_problem}): run make setup")
        return
    if not torch.cuda and not torch.hip:
        if any(card.capability is None or card.capability >= OLDEST_FOR_GSPLAT for card in facts.cards):
            text = f"{torch.version} is built for the CPU alone and ignores {facts.cards[0].name}: "
            yield Finding("note", "torch", text + "TORCH_CUDA=cu130 make setup takes the GPU build")
        else:
            yield Finding("ok", "torch", f"{torch.version}, for the CPU alone")
        return
    platform = f"CUDA {torch.cuda}" if torch.cuda else f"ROCm {torch.hip}"
    if facts.torch_problem:
        yield Finding("fix", "torch", f"{torch.version} for {platform}: {facts.torch_problem}")
        return
    if wrong := _misfit(facts):
        hopeless = all(card.capability and card.capability < OLDEST_FOR_GSPLAT for card in facts.cards)
        yield Finding("note" if hopeless else "fix", "torch", wrong)
        return
    yield Finding("ok", "torch", f"{torch.version} for {platform}")


def _misfit(facts: Facts) -> str | None:
    name = next((build.name for build in BUILDS.values() if build.cuda == facts.torch.cuda), None)
    return advice(facts.cards, name) if name else None


def gpu(facts: Facts) -> Iterator[Finding]:
    """The card torch uses, and its free memory against what a training asks for."""
    for card in facts.cards:
        memory = f", {card.total_gb:.1f} GB, {card.free_gb:.1f} GB free" if card.total_gb and card.free_gb else ""
        yield Finding("ok", "GPU", f"{card}, driver {card.driver}{memory}" if card.capability else f"{card}{memory}")
    torch = facts.torch
    if torch is None or torch.card is None:
        yield from _no_gpu(facts)
        return
    if not facts.cards:
        known = f", compute capability {dotted(torch.capability)}" if torch.cuda and torch.capability else ""
        yield Finding("ok", "GPU", f"{torch.card}{known}, {torch.free_gb:.1f} of {torch.total_gb:.1f} GB free")
    needed = facts.config.device.min_free_gb if facts.config else 0.0
    if torch.free_gb < needed:
        yield Finding(
            "fix", "GPU", f"{torch.card} has {torch.free_gb:.1f} GB of free memory, device.min_free_gb asks for "
            f"{needed:g}: a training will not start; end other programs on it (nvidia-smi lists them), take a smaller "
            "preset (presets/8gb.yaml), or lower train.cap_max, images.width and device.min_free_gb",
        )  # fmt: skip


def _no_gpu(facts: Facts) -> Iterator[Finding]:
    consequence = "the CPU demo runs; real scenes are refused unless you write device: cpu (very slow)"
    if facts.cards_problem:
        cure = "(re)install NVIDIA's driver (Ubuntu: sudo ubuntu-drivers install), then reboot"
        yield Finding("note", "GPU", f"{facts.cards_problem}: {cure}; until then {consequence}")
    elif facts.cards:
        built_for_gpu = facts.torch is not None and (facts.torch.cuda or facts.torch.hip)
        if built_for_gpu and _misfit(facts) is None:
            hidden = "torch sees none of them: is CUDA_VISIBLE_DEVICES set, or the driver freshly updated (reboot)?"
            yield Finding("fix", "GPU", hidden)
        else:
            yield Finding("note", "GPU", f"torch cannot use it (see torch above): {consequence}")
    else:
        amd = facts.torch is not None and facts.torch.hip
        missing = "this torch for ROCm sees no AMD GPU (see docs/amd.md)" if amd else "none found"
        yield Finding("note", "GPU", f"{missing}: {consequence}")


def gsplat(facts: Facts) -> Iterator[Finding]:
    """gsplat, and whether its kernels are compiled for the card."""
    found, torch = facts.gsplat, facts.torch
    if found is None:
        yield Finding("fix", "gsplat", f"not importable ({facts.gsplat_problem}): run make setup")
    elif found.problem:
        yield Finding(
            "fix", "gsplat", f"{found.version} cannot be loaded ({found.problem}): rm -r .venv, then make setup"
        )
    elif torch is None or not torch.cuda:
        where = "its kernels come with AMD's package" if torch and torch.hip else "its kernels are not needed on a CPU"
        yield Finding("ok", "gsplat", f"{found.version}; {where}")
    elif found.extension is None:
        yield from _uncompiled(facts)
    else:
        yield from _compiled(facts, torch)


def _uncompiled(facts: Facts) -> Iterator[Finding]:
    usable = facts.torch.capability is not None and facts.torch.capability >= OLDEST_FOR_GSPLAT
    text = f"{facts.gsplat.version} is not compiled: "
    if usable:
        brings = int(facts.torch.cuda.split(".")[0]) >= FROM_PYPI_SINCE
        nvcc = " (brings nvcc along)" if brings else f" with a CUDA {facts.torch.cuda} toolkit in CUDA_HOME"
        if facts.toolkit and same_major(facts.toolkit[1], facts.torch.cuda):
            nvcc = ""
        yield Finding(
            "fix", "gsplat", f"{text}a training on the GPU will be refused; run make setup{nvcc}, minutes, once"
        )
    else:
        yield Finding(
            "note", "gsplat", f'{text}no GPU to compile for; for one elsewhere: GSPLAT_ARCHS="8.6" make setup'
        )


def _compiled(facts: Facts, torch: Torch) -> Iterator[Finding]:
    archs = facts.gsplat.archs
    text = f"{facts.gsplat.version}, compiled ({facts.gsplat.extension})"
    if archs and torch.capability and not covers(archs, torch.capability):
        mine = dotted(torch.capability)
        yield Finding(
            "fix", "gsplat", f"{text} for compute capability {', '.join(archs)}, but {torch.card} has {mine}: "
            f'GSPLAT_ARCHS="{";".join([*archs, mine])}" make setup',
        )  # fmt: skip
    else:
        yield Finding("ok", "gsplat", text + (f" for compute capability {', '.join(archs)}" if archs else ""))


def triton(facts: Facts) -> Iterator[Finding]:
    """Whether the kernels that train faster can be compiled; of interest where there is a GPU alone."""
    if facts.torch is None or facts.torch.card is None:
        return
    if facts.triton_problem is None:
        yield Finding("ok", "Triton", "compiles for this GPU")
    else:
        yield Finding(
            "note", "Triton", f"cannot be used ({facts.triton_problem}): trainings take longer; it needs a C compiler "
            "and Python's headers (Ubuntu: sudo apt install gcc python3-dev)",
        )  # fmt: skip


def compiler(facts: Facts) -> Iterator[Finding]:
    """What compiling gsplat takes; of interest only until it is compiled."""
    done = facts.gsplat is not None and facts.gsplat.extension is not None
    if facts.torch is None or not facts.torch.cuda:
        return
    if facts.toolkit:
        yield Finding("ok", "CUDA toolkit", f"nvcc {facts.toolkit[1]} in {facts.toolkit[0]}")
    elif not done:
        major = int(facts.torch.cuda.split(".")[0])
        how = "make setup fetches it from PyPI where gsplat has to be compiled"
        if major < FROM_PYPI_SINCE:
            how = f"compiling gsplat needs CUDA {facts.torch.cuda}'s: see docs/installation.md"
        yield Finding("note", "CUDA toolkit", f"none; {how}")
    if facts.compile_problem and not done:
        needed = facts.torch.capability is not None
        yield Finding("fix" if needed else "note", "C++ compiler", facts.compile_problem)
    elif not done:
        yield Finding("ok", "C++ compiler", "found")


def config(facts: Facts) -> Iterator[Finding]:
    """The configuration."""
    if facts.config_problem:
        yield Finding("fix", "config", facts.config_problem)
    elif facts.config:
        scenes = len(facts.config.scenes)
        yield Finding("ok", "config", f"{scenes} scenes, methods {', '.join(facts.config.methods)}")


def datasets(facts: Facts) -> Iterator[Finding]:
    """The datasets that the config names."""
    for dataset in facts.datasets:
        yield _dataset(dataset)


def _dataset(dataset: Dataset) -> Finding:
    topic = f"dataset {dataset.name}"
    if dataset.root is not None:
        return Finding("ok", topic, f"found in {dataset.root}")
    if dataset.generated:
        return Finding("ok", topic, "not made yet: the workflow generates it where it is needed")
    return Finding("note", topic, f"{dataset.problem}; make demo needs none")


def disk(facts: Facts) -> Iterator[Finding]:
    """Free space where results and downloads go."""
    for folder, free in facts.disk_gb.items():
        text = f"{free:.1f} GB free for {folder}/"
        if free < LOWEST_DISK_GB:
            text += ": jobs will fail; make room, or let results_dir name a folder on another disk"
            yield Finding("fix", "disk", text)
        elif free < ROOMY_DISK_GB:
            text += f": enough for the demo; a real scene takes up to about a gigabyte, ten want {ROOMY_DISK_GB:g} GB"
            yield Finding("note", "disk", text)
        else:
            yield Finding("ok", "disk", text)


def backbone(facts: Facts) -> Iterator[Finding]:
    """LPIPS's AlexNet."""
    lpips, found = lpips_of(facts.config), facts.backbone
    if not lpips.enabled:
        yield Finding("ok", "LPIPS", "switched off (lpips.enabled), so its backbone is not needed")
    elif found.sha256 is None:
        text = f"LPIPS was null: {found.last_failure}"
        if not found.last_failure:
            text = "no AlexNet backbone yet: the first evaluation fetches it; without network LPIPS is null with that "
            text += f"reason, unless you put {lpips.url} at {BACKBONE}"
        yield Finding("note", "LPIPS", text)
    elif not found.sha256.startswith(lpips.sha256):
        yield Finding(
            "fix", "LPIPS", f"{BACKBONE} has SHA-256 {found.sha256[:16]}…, lpips.sha256 says {lpips.sha256}: LPIPS "
            f"will be null; remove the file, or replace it with {lpips.url}",
        )  # fmt: skip
    else:
        yield Finding("ok", "LPIPS", f"AlexNet backbone in {BACKBONE}, checksum right")


def ffmpeg(facts: Facts) -> Iterator[Finding]:
    """The program that writes videos."""
    if facts.ffmpeg:
        yield Finding("ok", "ffmpeg", facts.ffmpeg)
    else:
        yield Finding(
            "fix", "ffmpeg", "none: run make setup (imageio-ffmpeg brings one), or sudo apt-get install ffmpeg"
        )
