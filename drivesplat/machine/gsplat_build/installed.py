"""Whether gsplat is compiled, and for which cards: found out without importing gsplat, which might start compiling."""

import json
import re
from collections.abc import Iterable
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

RECORD = "csrc.build.json"
Capability = tuple[int, int]


def package_folder() -> Path | None:
    """The folder of the installed gsplat; None where there is none."""
    try:
        spec = find_spec("gsplat")
    except (ImportError, ValueError):
        return None
    return Path(spec.origin).parent if spec is not None and spec.origin else None


def compiled_extension() -> Path | None:
    """gsplat's compiled kernels, from a wheel or made at set-up.

    None where gsplat is sources alone, and where they were made at set-up for another version of torch or gsplat.
    """
    folder = package_folder()
    if folder is None:
        return None
    found = [folder / f"csrc{suffix}" for suffix in EXTENSION_SUFFIXES if (folder / f"csrc{suffix}").is_file()]
    record = build_record()
    if not found or (record and record.get("versions") != versions()):
        return None
    return found[0]


def build_record() -> dict[str, Any]:
    """What the set-up noted when it compiled: `archs` and `versions`. Empty where a wheel brought the kernels."""
    folder = package_folder()
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8")) if folder else {}
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def versions() -> dict[str, str | None]:
    """The installed versions that compiled kernels belong to."""
    return {name: _version(name) for name in ("torch", "gsplat")}


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def torch_platform() -> tuple[str | None, str | None]:
    """The CUDA and the ROCm version that the installed torch is built for, found out without importing it."""
    spec = find_spec("torch")
    file = Path(spec.origin).parent / "version.py" if spec is not None and spec.origin else None
    text = file.read_text(encoding="utf-8") if file is not None and file.is_file() else ""
    found = (re.search(rf"^{name}\b[^=\n]*= '([^']+)'", text, re.MULTILINE) for name in ("cuda", "hip"))
    cuda, hip = (match[1] if match else None for match in found)
    return cuda, hip


def covers(archs: Iterable[str], capability: Capability) -> bool:
    """Whether code for `archs` ("8.6", "9.0+PTX") runs on a card of this compute capability.

    Machine code runs on its own and later minor versions of one major version; PTX on everything later.
    CUDA C++ Programming Guide, "Binary compatibility" and "PTX compatibility".
    """
    for arch in archs:
        number, _, ptx = arch.partition("+")
        major, minor = (int(part) for part in number.rstrip("a").split("."))
        if (capability[0] == major and capability[1] >= minor) or (ptx and capability >= (major, minor)):
            return True
    return False
