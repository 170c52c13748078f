"""Everything the doctor looks at, found out in one place and kept in one record; `checks` judges it."""

import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from drivesplat.errors import DriveSplatError
from drivesplat.io.storage import sha256_file
from drivesplat.kernels import triton as on_gpu
from drivesplat.machine.doctor.torch_builds import Capability, Card, read_cards
from drivesplat.machine.gsplat_build import diagnose
from drivesplat.machine.gsplat_build.installed import build_record, compiled_extension, package_folder
from drivesplat.machine.gsplat_build.toolkit import nvcc_release, own_home, system_homes
from drivesplat.readers.datasets import layout
from drivesplat.settings.config import Config, load, merged
from drivesplat.settings.evaluate import BACKBONE, BACKBONE_RECORD, LpipsSettings

STAMP = ".venv/.made-from"


@dataclass(frozen=True)
class Torch:
    """The installed torch and what it sees."""

    version: str
    cuda: str | None = None
    hip: str | None = None
    archs: tuple[str, ...] = ()
    """Compute capabilities it holds code for, as "sm_86"; on ROCm "gfx942"."""
    card: str | None = None
    """The name of the GPU it would use; None where it sees none."""
    capability: Capability | None = None
    free_gb: float | None = None
    total_gb: float | None = None


@dataclass(frozen=True)
class Gsplat:
    """The installed gsplat."""

    version: str
    extension: str | None = None
    """Its compiled kernels; None where it is sources alone."""
    archs: tuple[str, ...] | None = None
    """What they were compiled for; None where a wheel brought them."""
    problem: str | None = None
    """Why they cannot be loaded."""


@dataclass(frozen=True)
class Dataset:
    """A dataset of the config: found at `root`, made by the workflow, or not there for a reason."""

    name: str
    root: str | None = None
    problem: str | None = None
    generated: bool = False


@dataclass(frozen=True)
class Backbone:
    """LPIPS's AlexNet: its SHA-256 where the file is there, and why the last attempt to fetch it failed."""

    sha256: str | None = None
    last_failure: str | None = None


@dataclass(frozen=True)
class Facts:
    """What was found on this machine. The defaults are those of a machine without a GPU where all else is well."""

    python: tuple[int, int] = (3, 11)
    executable: str = ".venv/bin/python"
    outdated: bool = False
    """.venv was made from other requirements than the present ones."""
    cards: tuple[Card, ...] = ()
    cards_problem: str | None = None
    torch: Torch | None = None
    torch_problem: str | None = None
    gsplat: Gsplat | None = None
    gsplat_problem: str | None = None
    toolkit: tuple[str, str] | None = None
    """Folder and release of a CUDA toolkit."""
    compile_problem: str | None = None
    """What compiling needs and this machine lacks: a C++ compiler, Python's headers."""
    config: Config | None = None
    config_problem: str | None = None
    datasets: tuple[Dataset, ...] = ()
    disk_gb: dict[str, float] = field(default_factory=dict)
    """Free space by folder."""
    backbone: Backbone = Backbone()
    ffmpeg: str | None = None
    triton_problem: str | None = None
    """Why kernels that train faster cannot be compiled for the GPU that torch sees."""
    read_as_source: int = 0
    """How many of the modules read here Python has not kept compiled, and cannot keep: every process compiles them."""


def gather(root: Path, config_files: Sequence[Path]) -> Facts:
    """Looks at everything. Changes nothing, fetches nothing, compiles nothing but Triton's trial."""
    cards, cards_problem = read_cards()
    torch, torch_problem = _torch()
    gsplat, gsplat_problem = _gsplat(cuda=bool(torch and torch.cuda))
    config, config_problem = _config(config_files)
    results = config.results_dir if config else "results"
    return Facts(
        python=sys.version_info[:2],
        executable=sys.executable,
        outdated=_outdated(root),
        cards=tuple(cards),
        cards_problem=cards_problem,
        torch=torch,
        torch_problem=torch_problem,
        gsplat=gsplat,
        gsplat_problem=gsplat_problem,
        toolkit=_toolkit(),
        compile_problem=diagnose.what_is_missing(),
        config=config,
        config_problem=config_problem,
        datasets=_datasets(config) if config else (),
        disk_gb={name: free_disk_gb(root / name) for name in (results, "resources")},
        backbone=_backbone(root),
        ffmpeg=_ffmpeg(),
        triton_problem=on_gpu.problem() if torch and torch.card else None,
        read_as_source=_read_as_source(),
    )


def _torch() -> tuple[Torch | None, str | None]:
    try:
        torch = import_module("torch")
    except Exception as error:  # a broken installation fails in any way
        return None, f"{type(error).__name__}: {error}"
    known = {"version": torch.__version__, "cuda": torch.version.cuda, "hip": torch.version.hip}
    known["archs"] = tuple(torch.cuda.get_arch_list())
    if not torch.cuda.is_available():
        return Torch(**known), None
    try:
        free, total = torch.cuda.mem_get_info()
        name, capability = torch.cuda.get_device_name(), torch.cuda.get_device_capability()
    except RuntimeError as error:
        return Torch(**known), f"the GPU cannot be used: {error}"
    return Torch(**known, card=name, capability=capability, free_gb=free / 1e9, total_gb=total / 1e9), None


def _read_as_source() -> int:
    specs = [getattr(module, "__spec__", None) for module in list(sys.modules.values())]
    kept = [spec.cached for spec in specs if spec is not None and spec.has_location and spec.cached]
    return sum(not Path(file).exists() for file in kept)


def _gsplat(cuda: bool) -> tuple[Gsplat | None, str | None]:
    if package_folder() is None:
        return None, "no module named gsplat"
    extension, archs = compiled_extension(), build_record().get("archs")
    problem = None
    try:
        import_module("gsplat")
        if extension is not None and cuda:
            import_module("gsplat.csrc")
    except Exception as error:  # compiled code can fail to load in any way
        problem = f"{type(error).__name__}: {error}"
    kernels = str(extension) if extension else None
    return Gsplat(_version("gsplat", "amd_gsplat"), kernels, tuple(archs) if archs else None, problem), None


def _version(*names: str) -> str:
    for name in names:
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "of unknown version"


def _toolkit() -> tuple[str, str] | None:
    given = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    for home in [Path(given)] if given else [own_home(), *system_homes()]:
        if release := nvcc_release(home):
            return str(home), release
    return None


def _config(files: Sequence[Path]) -> tuple[Config | None, str | None]:
    import yaml

    values: dict = {}
    try:
        for file in files:
            values = merged(values, yaml.safe_load(file.read_text(encoding="utf-8")) or {})
        return load(values), None
    except (OSError, yaml.YAMLError, DriveSplatError) as error:
        return None, " ".join(str(error).split())


def _datasets(config: Config) -> tuple[Dataset, ...]:
    found = []
    for name, dataset in config.datasets.items():
        generated = getattr(dataset, "world", None) is not None
        files = layout(dataset.reader)
        try:
            root = files.find_root(dataset.dataroot, dataset.version)
            files.table_files(root, dataset.version)
            found.append(Dataset(name, str(root), generated=generated))
        except DriveSplatError as error:
            found.append(Dataset(name, problem=str(error), generated=generated))
    return tuple(found)


def free_disk_gb(path: Path) -> float:
    """Free space where `path` is, or will be, in GB."""
    path = path.absolute()
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free / 1e9


def _backbone(root: Path) -> Backbone:
    try:
        failure = json.loads((root / BACKBONE_RECORD).read_text(encoding="utf-8")).get("unavailable")
    except (OSError, ValueError, AttributeError):
        failure = None
    file = root / BACKBONE
    return Backbone(sha256_file(file) if file.is_file() else None, failure)


def lpips_of(config: Config | None) -> LpipsSettings:
    """The settings of LPIPS; the defaults where the config cannot be read."""
    return config.lpips if config else LpipsSettings()


def _ffmpeg() -> str | None:
    try:
        return import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return shutil.which("ffmpeg")


def _outdated(root: Path) -> bool:
    """Whether this Python is the checkout's .venv and was made from other requirements than the present ones."""
    stamp = root / STAMP
    if Path(sys.prefix).resolve() != (root / ".venv").resolve() or not stamp.is_file():
        return False
    present = sha256(b"".join((root / name).read_bytes() for name in ("requirements.txt", "constraints.txt")))
    return stamp.read_text(encoding="utf-8").split()[:1] != [present.hexdigest()]
