"""Whether gsplat is compiled, and for which GPUs, without importing gsplat, which might start compiling."""

import json
import re
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from drivesplat.provenance.record import package_version

RECORD = "csrc.build.json"


def package_folder(name: str = "gsplat") -> Path | None:
    """The folder of an installed package; None if it is not installed."""
    try:
        spec = find_spec(name)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin).parent if spec is not None and spec.origin else None


def compiled_extension() -> Path | None:
    """gsplat's compiled kernels, from a wheel or from set-up.

    None if gsplat has only sources, or if its kernels were compiled at set-up for another version of torch or gsplat.
    """
    folder = package_folder()
    if folder is None:
        return None
    files = (folder / f"csrc{suffix}" for suffix in EXTENSION_SUFFIXES)
    record = build_record()
    outdated = record and record.get("versions") != versions()
    return None if outdated else next((file for file in files if file.is_file()), None)


def build_record() -> dict[str, Any]:
    """The `archs` and `versions` recorded when set-up compiled the kernels; empty if they came with a wheel."""
    folder = package_folder()
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8")) if folder else {}
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def versions() -> dict[str, str | None]:
    """The installed versions to which compiled kernels belong."""
    return {name: package_version(name) for name in ("torch", "gsplat")}


def torch_platform() -> tuple[str | None, str | None]:
    """The CUDA and the ROCm version of the installed torch, without importing it."""
    folder = package_folder("torch")
    file = folder / "version.py" if folder else None
    text = file.read_text(encoding="utf-8") if file is not None and file.is_file() else ""
    found = (re.search(rf"^{name}\b[^=\n]*= '([^']+)'", text, re.MULTILINE) for name in ("cuda", "hip"))
    cuda, hip = (match[1] if match else None for match in found)
    return cuda, hip
