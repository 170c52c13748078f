"""Which build of torch an NVIDIA card and its driver can run; asked by the set-up before anything is installed.

    python -m drivesplat.machine.doctor.torch_builds [BUILD]     exit status 0: the build fits, 1: it does not (says
    which does)

torch 2.11 comes for CUDA 13.0 (the wheel on PyPI), 12.8, 12.6 and for the CPU alone. What each can run on stands in
PyTorch's release matrix (pytorch/pytorch, RELEASE.md) and in NVIDIA's table of minimum drivers ("CUDA Compatibility",
minor version compatibility); that gsplat 1.x needs compute capability 7.0 in nerfstudio-project/gsplat, issue 401.
"""

import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

Capability = tuple[int, int]
DEFAULT = "cu130"
OLDEST_FOR_GSPLAT: Capability = (7, 0)
QUERY = ("name", "driver_version", "memory.total", "memory.free", "compute_cap")


@dataclass(frozen=True)
class TorchBuild:
    """A build of torch, and what it can run on."""

    name: str
    cuda: str
    oldest_driver: str
    oldest_card: Capability
    newest_card: Capability


BUILDS = {
    build.name: build
    for build in (
        TorchBuild("cu130", "13.0", "580", (7, 5), (12, 1)),
        TorchBuild("cu128", "12.8", "525.60.13", (7, 5), (12, 1)),
        TorchBuild("cu126", "12.6", "525.60.13", (5, 0), (8, 9)),
    )
}
"""In order of preference. cu126 lists Hopper, too, in some releases; cu128 has it for certain."""
CPU = "cpu"
GENERATIONS = (
    ((5, 0), "older than Maxwell"), ((6, 0), "Maxwell"), ((7, 0), "Pascal"), ((7, 5), "Volta"), ((8, 0), "Turing"),
    ((8, 9), "Ampere"), ((9, 0), "Ada"), ((10, 0), "Hopper"),
)  # fmt: skip


@dataclass(frozen=True)
class Card:
    """A GPU as nvidia-smi tells of it; what it does not tell is None."""

    name: str
    driver: str
    capability: Capability | None = None
    total_gb: float | None = None
    free_gb: float | None = None

    def __str__(self) -> str:
        if self.capability is None:
            return f"{self.name} (driver {self.driver})"
        return f"{self.name} ({generation(self.capability)}, compute capability {dotted(self.capability)})"


def dotted(capability: Capability) -> str:
    """A compute capability as NVIDIA writes it."""
    return f"{capability[0]}.{capability[1]}"


def generation(capability: Capability) -> str:
    """The name of a card's architecture."""
    return next((name for end, name in GENERATIONS if capability < end), "Blackwell")


def read_cards(run: Callable[..., subprocess.CompletedProcess] = subprocess.run) -> tuple[list[Card], str | None]:
    """The NVIDIA cards, and why none could be asked; None where all is well or there is no nvidia-smi."""
    said = ""
    for fields in (QUERY, QUERY[:-1]):  # nvidia-smi of drivers before 510 does not know compute_cap
        command = ["nvidia-smi", f"--query-gpu={','.join(fields)}", "--format=csv,noheader,nounits"]
        try:
            done = run(command, capture_output=True, text=True, check=False, timeout=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            return [], None if isinstance(error, FileNotFoundError) else f"nvidia-smi does not answer ({error})"
        if done.returncode == 0:
            cards = [_card(line) for line in done.stdout.splitlines() if line.count(",") >= len(fields) - 1]
            return cards, None if cards else "nvidia-smi knows of no GPU"
        said = " ".join((done.stdout + " " + done.stderr).split())
    return [], f"nvidia-smi fails: {said or 'no message'}"


def _card(line: str) -> Card:
    name, driver, total, free, *rest = (part.strip() for part in line.split(","))
    match = re.fullmatch(r"(\d+)\.(\d+)", rest[0]) if rest else None
    return Card(name, driver, (int(match[1]), int(match[2])) if match else None, _gb(total), _gb(free))


def _gb(mebibytes: str) -> float | None:
    return int(mebibytes) * 2**20 / 1e9 if mebibytes.isdigit() else None


def at_least(version: str, other: str) -> bool:
    """Whether a driver's version is `other` or later."""
    return [int(n) for n in re.findall(r"\d+", version)] >= [int(n) for n in re.findall(r"\d+", other)]


def misfit(card: Card, build: TorchBuild) -> str | None:
    """Why a card cannot run a build of torch; None where it can, as far as is known."""
    if card.capability is not None and not build.oldest_card <= card.capability <= build.newest_card:
        newest = ", ".join(dotted(limit) for limit in (build.oldest_card, build.newest_card))
        return f"torch for CUDA {build.cuda} covers compute capabilities {newest.replace(', ', ' to ')}"
    if not at_least(card.driver, build.oldest_driver):
        return f"torch for CUDA {build.cuda} needs driver {build.oldest_driver} or newer"
    return None


def fitting_build(card: Card) -> str | None:
    """The best build for a card that gsplat can run on; None where there is none."""
    if card.capability is not None and card.capability < OLDEST_FOR_GSPLAT:
        return None
    fits = [build.name for build in BUILDS.values() if misfit(card, build) is None]
    if fits and fits[0] != DEFAULT and "cu126" in fits:
        return "cu126"  # PyTorch's long-kept build for older drivers and cards
    return fits[0] if fits else None


def advice(cards: Sequence[Card], build_name: str) -> str | None:
    """What is wrong with a build of torch for these cards, with what to do; None where one of them can run it."""
    if build_name == CPU or not cards:
        return None
    build = BUILDS[build_name]
    usable = [c for c in cards if c.capability is None or c.capability >= OLDEST_FOR_GSPLAT]
    if not usable:
        return (
            f"{cards[0]} is too old for gsplat, which needs compute capability 7.0 (Volta) or newer; no build of torch "
            "changes that. The CPU demo runs: TORCH_CUDA=cpu make setup"
        )
    if any(misfit(card, build) is None for card in usable):
        return None
    card = max(usable, key=lambda c: c.capability or (0, 0))
    better = fitting_build(card)
    has = f"{card} has driver {card.driver}" if card.capability else f"there is {card}"
    update = f"update NVIDIA's driver to {BUILDS[DEFAULT].oldest_driver} or newer"
    if better is None:
        return f"{has}, but {misfit(card, build)}: {update}, or go without a GPU: TORCH_CUDA=cpu make setup"
    take = f"take the build for CUDA {BUILDS[better].cuda}: TORCH_CUDA={better} make setup"
    if better == DEFAULT:
        take = "take the default build: TORCH_CUDA=cu130 make setup"
    elif card.capability is None or card.capability >= BUILDS[DEFAULT].oldest_card:
        take = f"{update} (best), or {take}"
    return f"{has}, but {misfit(card, build)}: {take}"


def main(arguments: Sequence[str]) -> int:
    """Says what is wrong with a build for the cards at hand. Returns the exit status; 2 for an unknown build."""
    name = arguments[0] if arguments else DEFAULT
    if name != CPU and name not in BUILDS:
        print(f"setup: TORCH_CUDA={name} is not known; there are: {', '.join([*BUILDS, CPU])}", file=sys.stderr)
        return 2
    cards, problem = read_cards()
    if problem and name != CPU:
        print(f"setup: no NVIDIA GPU can be asked: {problem}", file=sys.stderr)
    sentence = advice(cards, name)
    if sentence:
        print(f"setup: {sentence}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
